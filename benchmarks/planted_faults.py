"""Put into docs/faults.md every planted fault, the checks that catch it, and faults none can catch.

PYTHONPATH=tests python -m benchmarks.planted_faults docs/faults.md
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from faults.bench import checked, told
from faults.faults import FAULTS
from faults.planting import Fault
from faults.scenes import SCENES

from benchmarks.harness import placed
from benchmarks.smallest_fault import table
from mbds_xsim.base.files import write_whole


@dataclass(frozen=True)
class _Try:
    engine: str
    caught: bool
    """Whether the fault is caught on the motion alone, and no other engine failed."""
    failed: frozenset[str]
    odd: bool
    told: bool


def main(page: Path) -> None:
    """Put into the page what was found; all other text in it stays as it is."""
    text = page.read_text("utf-8")
    for name in ("faults", "smallest", "unseen"):
        placed(text, name, "")  # a page without the marks is told before hours of work
    tries = {fault: [_try(fault, engine) for engine in fault.engines] for fault in FAULTS}
    parts = {"faults": _faults(tries), "smallest": table(), "unseen": _unseen(tries)}
    for name, lines in parts.items():
        text = placed(text, name, "\n".join(lines))
    write_whole(page, text.encode())


def _faults(tries: dict[Fault, list[_Try]]) -> Iterator[str]:
    clocks = ", ".join(f"{frames} of {name}" for name, frames in SCENES.items())
    yield from (textwrap.fill(f"Recorded frames are {clocks}.", 100), "", _count(tries), "")
    yield "| fault | scene | caught in | by | odd one out | read back |"
    yield "| --- | --- | --- | --- | --- | --- |"
    yield from (_row(fault, results) for fault, results in tries.items())


def _try(fault: Fault, engine: str) -> _Try:
    motion = checked(fault.scene, fault, engine)
    bad = [row.engine for row in motion.engines if row.verdict == "fail"]
    row = next(row for row in motion.engines if row.engine == engine)
    return _Try(
        engine,
        bad == [engine],
        frozenset(finding.check for finding in row.findings if not finding.passed),
        motion.odd_one_out == f"{engine} matched",
        not fault.change.only_recorded and bool(told(fault.scene, fault, engine)),
    )


def _count(tries: dict[Fault, list[_Try]]) -> str:
    plantings = [run for results in tries.values() for run in results]
    caught = sum(run.caught for run in plantings)
    readback = sum(run.told for run in plantings)
    whole = sum(all(run.caught for run in results) for results in tries.values())
    either = sum(run.caught or run.told for run in plantings)
    return (
        f"**{caught} of {len(plantings)}** plantings are caught on the motion alone, {whole} of "
        f"{len(tries)} faults in every engine they were planted in; {readback} are told by reading "
        f"the model back, and {either} by one or the other."
    )


def _row(fault: Fault, results: list[_Try]) -> str:
    caught = [run for run in results if run.caught]
    engines = ", ".join(run.engine for run in caught) or "none"
    if caught and len(caught) < len(results):
        engines += f" ({len(caught)} of {len(results)})"
    return (
        f"| {fault.name} | {fault.scene} | {engines} | {_checks(fault, caught)} "
        f"| {_share([run.odd for run in results])} | {_share([run.told for run in results])} |"
    )


def _checks(fault: Fault, caught: list[_Try]) -> str:
    """Return the checks that fail in every engine; if there is none, those meant for the fault."""
    if not caught:
        return "–"
    always = frozenset.intersection(*(run.failed for run in caught))
    return ", ".join(sorted(always)) or " or ".join(fault.checks)


def _share(marks: list[bool]) -> str:
    return f"{sum(marks)} of {len(marks)}" if any(marks) else "–"


def _unseen(tries: dict[Fault, list[_Try]]) -> Iterator[str]:
    for fault, results in tries.items():
        reasons: dict[str, list[str]] = {}
        for run in results:
            if not run.caught:
                reason = fault.unseen.get(run.engine, "no reason is known")
                reasons.setdefault(reason, []).append(run.engine)
        for reason, engines in reasons.items():
            yield f"- {fault.name.capitalize()}, in {', '.join(engines)}: {reason}."


if __name__ == "__main__":
    main(Path(sys.argv[1]))
