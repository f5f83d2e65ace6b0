"""Write reports/data.md: which generated data were published, and whether they verify again.

python -m benchmarks.acceptance DIR [DIR …] > reports/data.md

Each folder is written by `make reports-data`. It holds `data`, the JSON results of `generate`,
`verify` and `export`, and the commands.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from benchmarks.harness import print_head, print_table, stored
from mbds_xsim.dataset.shard import stage_times
from mbds_xsim.dataset.summary import Summary, summaries

TEXT = """\
Every trajectory that was drawn is checked, and only what passes is published; rejected ones are
counted by the check that failed first, and not replaced. Times are of one core, from the logs of
the shards: drawing, simulating, checking (and the reference of the audit sample), writing and
reading back; `of it engine` is the simulation's part. `verify` reads all of it again from the files
alone. What is published, and how, is explained in
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
    """Print the section of one run."""
    files = {name: folder / f"{name}.json" for name in ("generate", "verify", "export")}
    results = {name: stored(file, dict) if file.exists() else {} for name, file in files.items()}
    sets = summaries(folder / "data")
    scenes = ", ".join(dict.fromkeys(summary.scene for summary in sets))
    print(f"## {scenes}: {max(summary.drawn for summary in sets):,} trajectories each\n")
    print(f"```sh\n{(folder / 'commands').read_text('utf-8').strip()}\n```\n")
    print_table(HEADINGS, (row(summary, results["verify"]) for summary in sets))
    print()
    for pair, reason in results["generate"].get("left_out", {}).items():
        print(f"{pair} left out: {reason}\n")
    print(totals(sets, results), end="\n\n")


def row(summary: Summary, verified: dict[str, Any]) -> tuple[str, ...]:
    seconds = stage_times(Path(summary.file))
    whole = sum(seconds.values())
    causes = ", ".join(f"{cause} {count}" for cause, count in sorted(summary.rejected_by.items()))
    return (
        summary.scene,
        f"{summary.engine} {summary.engine_version}",
        f"{summary.profile}: {summary.method}, {summary.step_s:.4g} s",
        f"{summary.drawn:,}",
        f"{summary.published:,}",
        f"{summary.rejected:,}",
        causes,
        summary.certification,
        f"{whole:.1f}",
        f"{seconds['simulate_s'] / whole:.0%}",
        f"{summary.bytes / 1e6:.4g}",
        verdict(Path(summary.file), verified),
    )


def verdict(joined: Path, verified: dict[str, Any]) -> str:
    """Return `verify`'s verdict on a set: its joined file, shards and rejected trajectories."""
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


def totals(sets: list[Summary], results: dict[str, dict[str, Any]]) -> str:
    drawn, published = (sum(getattr(s, key) for s in sets) for key in ("drawn", "published"))
    size = sum(summary.bytes for summary in sets)
    text = f"{published:,} of {drawn:,} trajectories published, {size / 1e9:.3g} GB"
    generated, verified, exported = (results[key] for key in ("generate", "verify", "export"))
    if generated.get("made") == drawn:
        rate = drawn / generated["wall_s"]
        text += f", made in {generated['wall_s']:,.0f} s of wall time ({rate:.3g} a second)"
    if verified:
        files, problems = verified["files"], sum(len(r["problems"]) for r in verified["files"])
        outcome = f"{problems} problems" if problems else "everything holds what it says"
        text += f". `verify` of {len(files):,} files in {verified['wall_s']:,.0f} s: {outcome}"
    if exported:
        count, files = exported["trajectories"], exported["files"]
        text += f". Exported: {count:,} in {files:,} files, {exported['bytes'] / 1e9:.3g} GB"
    return f"{text}."


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
