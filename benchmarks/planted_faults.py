"""Write docs/faults.md: every planted fault, the checks that catch it, and faults none can catch.

PYTHONPATH=tests python benchmarks/planted_faults.py > docs/faults.md
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass

from faults.bench import checked, told
from faults.faults import FAULTS
from faults.planting import Fault
from faults.scenes import SCENES
from smallest_fault import table

_HEAD = """\
# Do the checks bite?

<!-- Written by: PYTHONPATH=tests python benchmarks/planted_faults.py > docs/faults.md -->

Faults are planted one at a time into one engine, as a user's mistake would be: in the scene, the
settings or the inputs that reach the adapter, in the adapter itself, or in what it records. Then
the scene is validated in all four engines. A fault counts as caught where that engine fails and
the three others pass. This is judged on the motion alone, with the comparison of the native model
with the scene (read-back) switched off. The table shows the checks that fail in every engine that
has the fault (where they differ, one or another of them), how often the vote of the engines and the
reference names that engine, and how often reading the model back tells the fault too.

Without a fault all engines pass. `tests/faults` repeats the table in every test run. The scenes
are built-in ones, cut short and some started in another way (`tests/faults/scenes.py`). Recorded
frames are
{clocks}.
"""

_SMALLEST = """
## How small a fault is caught

The smallest error, to a third, that fails `mbds-xsim validate SCENE --engines ENGINE`, again on
the motion alone: one body too heavy by a share of its mass, or gravity too strong. It is found by
`benchmarks/smallest_fault.py`. The comparison of runs at three steps with the reference is what
sees errors so far below the budgets; how far depends on how exactly the engine's own error at
these steps can be extrapolated.

Contact has no such comparison, but laws that each frame must keep to. There the smallest error is
the budget: 2 % of the friction under balls and wheels that slip, 0.01 of a ball's restitution,
0.05 of the one of other single impacts, and for the radius of a sphere 0.2 % of the scene's length.
All impacts of a run together tell 0.02 of restitution and 3 % of friction, with four errors each.
Gravity shows under wheels that slip, by friction that the weight cannot have: 1 % leaves up to four
times the budget of *cones*. Under what rolls, sticks or flies seldom it shows less or not at all.
"""

_NEVER = """
## What is not caught

{unseen}
- Errors below the figures above.
- Contact spheres a little too small on a body that tumbles, in MuJoCo and Exudyn: a soft contact
  lets spheres in as far. Once the body rests they are seen.
- Friction where no contact slips, and of a body that tumbles in trajectories with few single
  impacts. Under balls and wheels that slip every frame shows it.
- A mistake in what all share: adapters and reference get masses, centres of mass, inertias and
  anchors from one module, `mbds_xsim/scene/mechanism.py`. If that is wrong, all agree on a wrong
  motion.
  It is tested against closed forms instead (`tests/scene/test_mechanism.py`).
- What the scene does not exercise, of which the faults above are examples. Reading the native
  model back tells such a mistake all the same, where the engine says what it holds: PyBullet does
  not tell the damping of its links and its joint motors, nor do PyBullet and DART tell the axes
  of hinges that close loops.
"""


@dataclass(frozen=True)
class _Try:
    engine: str
    caught: bool
    """Whether the fault is caught on the motion alone, and no other engine failed."""
    failed: frozenset[str]
    odd: bool
    told: bool


def page() -> Iterator[str]:
    """Yield the page line by line."""
    tries = {fault: [_try(fault, engine) for engine in fault.engines] for fault in FAULTS}
    clocks = ", ".join(f"{frames} of {name}" for name, frames in SCENES.items())
    yield _HEAD.format(clocks=textwrap.fill(clocks, 100))
    yield from _count(tries)
    yield ""
    yield "| fault | scene | caught in | by | odd one out | read back |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for fault, results in tries.items():
        yield _row(fault, results)
    yield _SMALLEST
    yield from table()
    yield _NEVER.format(unseen="\n".join(_unseen(tries)))


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


def _count(tries: dict[Fault, list[_Try]]) -> Iterator[str]:
    plantings = [run for results in tries.values() for run in results]
    caught = sum(run.caught for run in plantings)
    readback = sum(run.told for run in plantings)
    whole = sum(all(run.caught for run in results) for results in tries.values())
    either = sum(run.caught or run.told for run in plantings)
    yield (
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
    for line in page():
        print(line, flush=True)
