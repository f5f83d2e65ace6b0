"""README's table of engines, steps and costs, from the stored trade-offs of its scenes.

python benchmarks/choose_table.py reports/tradeoff                    prints it
python benchmarks/choose_table.py reports/tradeoff --into README.md   puts it in its place
"""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec

from mbds_xsim.report.choose_table import choose_table
from mbds_xsim.studies.tradeoff.rows import Tradeoff
from mbds_xsim.write import write_whole

BEGIN, END = "<!-- choose-table: begin -->\n", "<!-- choose-table: end -->"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--into", type=Path)
    asked = parser.parse_args()
    files = sorted(asked.folder.glob("*.json"))
    table = choose_table([msgspec.json.decode(file.read_bytes(), type=Tradeoff) for file in files])
    if asked.into is None:
        print(table)
    else:
        write_whole(asked.into, placed(asked.into.read_text("utf-8"), table).encode())


def placed(page: str, table: str) -> str:
    """Put the table between its marks."""
    before, _, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        msg = f"no place for the table: give it the lines {BEGIN.strip()} and {END}"
        raise SystemExit(msg)
    return f"{before}{BEGIN}{table}\n{END}{after}"


if __name__ == "__main__":
    main()
