"""Write reports/data.md: what of generated data was published, and whether it stands up again.

python -m benchmarks.acceptance DIR [DIR …] > reports/data.md

Each folder is what `make reports-data` leaves: `data`, the results that `generate`, `verify` and
`export` wrote as JSON, and the commands.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.harness import print_head, print_table
from mbds_xsim.dataset.shard import spent
from mbds_xsim.dataset.summary import Summary, summaries

TEXT = """\
Every trajectory that was drawn is checked, and only what passes is published; rejected ones are
counted by the check that failed first, and not replaced. Times are of one core, from the logs of
the shards: drawing, simulating, checking (and the reference of the audit sample), writing and
reading back; `of it engine` is the simulation's part. `verify` reads all of it again from the files
alone. What is published and how is told in
[Data sets: files and layout](../docs/dataset-layout.md).
"""
HEADINGS = (
    "scene|engine|settings|>drawn|>published|>rejected|rejected by||>core time [s]"
    "|>of it engine|>MB|`verify`"
)


def main(folders: list[Path]) -> None:
    """Print the page."""
    print_head("Data sets", "make reports-data reports-data-full", TEXT)
    for folder in folders:
        section(folder)


def section(folder: Path) -> None:
    """Tell of the data of one run."""
    told = {name: read(folder / f"{name}.json") for name in ("generate", "verify", "export")}
    sets = summaries(folder / "data")
    scenes = ", ".join(dict.fromkeys(each.scene for each in sets))
    print(f"## {scenes}: {max(each.drawn for each in sets):,} trajectories each\n")
    print(f"```sh\n{(folder / 'commands').read_text('utf-8').strip()}\n```\n")
    print_table(HEADINGS, (row(each, told["verify"]) for each in sets))
    print()
    for pair, why in told["generate"].get("left_out", {}).items():
        print(f"{pair} left out: {why}\n")
    print(totals(sets, told), end="\n\n")


def read(path: Path) -> dict[str, Any]:
    """Give a result; nothing where there is none."""
    return dict(json.loads(path.read_text("utf-8"))) if path.exists() else {}


def row(each: Summary, verified: dict[str, Any]) -> tuple[str, ...]:
    seconds = spent(Path(each.file))
    whole = sum(seconds.values())
    causes = ", ".join(f"{cause} {count}" for cause, count in sorted(each.rejected_by.items()))
    return (
        each.scene,
        f"{each.engine} {each.engine_version}",
        f"{each.profile}: {each.method}, {each.step_s:.4g} s",
        f"{each.drawn:,}",
        f"{each.published:,}",
        f"{each.rejected:,}",
        causes,
        each.certification,
        f"{whole:.1f}",
        f"{seconds['simulate_s'] / whole:.0%}",
        f"{each.bytes / 1e6:.4g}",
        verdict(Path(each.file), verified),
    )


def verdict(joined: Path, verified: dict[str, Any]) -> str:
    """What `verify` says of a set: of its joined file, its shards, and its rejected ones."""
    mine = {joined.with_suffix("").parts[-2:], joined.parts[-2:]}
    reports = [
        report
        for report in verified.get("files", [])
        if {Path(report["file"]).parts[-2:], Path(report["file"]).parts[-3:-1]} & mine
    ]
    problems = sum(len(report["problems"]) for report in reports)
    if not reports:
        return "not looked at"
    return f"{problems} problems" if problems else f"sound, {len(reports)} files"


def totals(sets: list[Summary], told: dict[str, dict[str, Any]]) -> str:
    drawn, published = (sum(getattr(s, key) for s in sets) for key in ("drawn", "published"))
    size = sum(each.bytes for each in sets)
    text = f"{published:,} of {drawn:,} trajectories published, {size / 1e9:.3g} GB"
    generated, verified, exported = (told[key] for key in ("generate", "verify", "export"))
    if generated.get("made") == drawn:
        rate = drawn / generated["wall_s"]
        text += f", made in {generated['wall_s']:,.0f} s of wall time ({rate:.3g} a second)"
    if verified:
        files, problems = verified["files"], sum(len(r["problems"]) for r in verified["files"])
        said = f"{problems} problems" if problems else "everything holds what it says"
        text += f". `verify` of {len(files):,} files in {verified['wall_s']:,.0f} s: {said}"
    if exported:
        count, files = exported["trajectories"], exported["files"]
        text += f". Exported: {count:,} in {files:,} files, {exported['bytes'] / 1e9:.3g} GB"
    return f"{text}."


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
