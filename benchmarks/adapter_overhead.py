"""What the adapters cost beside their engines.

python -m benchmarks.adapter_overhead [SCENE…] > reports/adapter-overhead.md

Each engine gets the adapter's own native model at matched settings. The adapter's rollout of a
start and a lean loop by hand (`lean_loops`) take turns on it. The aim is an overhead of 10 %.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median, quantiles
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import (
    both_s,
    print_head,
    print_made,
    print_table,
    processor_s,
    take_turns,
)
from benchmarks.lean_loops import LEAN, Lean, apart, exudyn_in_one_call, mujoco_coordinates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.matched import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene

Array = NDArray[np.float64]

SCENES = ("6pendulum", "3ladder", "simplecubli")
STARTS, REPEATS = 3, (15, 91)
PATIENCE = 2.0  # seconds of engine time a line may take, if the repeats are enough
MOST = 0.10
TOGETHER = {"mujoco": 10}
"""Starts in one call where one takes but milliseconds, as data sets and `validate` have them."""


@dataclass(frozen=True)
class Pairing:
    """What is measured."""

    scene: str
    engine: str
    starts: int = 1
    """In one call of the adapter."""
    loop: Callable[[Any, Batch], Lean] | None = None
    """In place of the engine's usual lean loop."""
    note: str = ""


CASES = (
    *(Pairing(scene, engine, TOGETHER.get(engine, 1)) for scene in SCENES for engine in LEAN),
    *(Pairing(scene, "mujoco", 1, note="1 start a call") for scene in SCENES),
    *(
        Pairing(
            scene, "mujoco", TOGETHER["mujoco"], mujoco_coordinates, "against coordinates alone"
        )
        for scene in SCENES
    ),
    *(
        Pairing(scene, "exudyn", loop=exudyn_in_one_call, note="against one call of the solver")
        for scene in SCENES[:2]
    ),
)


@dataclass(frozen=True)
class Overhead:
    """A line of the table; times of the processor [s]."""

    case: Pairing
    adapter: float
    lean: float
    ratios: Array
    """Of the processor's times, one a repeat."""
    wall: float
    """Median ratio of wall times."""
    load: float
    start: float
    apart: float


def measure(case: Pairing) -> Overhead:
    """Let the adapter and the lean loop take turns on one native model."""
    scene, adapter = load_scene(case.scene), load_adapter(case.engine)
    settings = settings_for(scene, adapter, "matched")
    load = median(processor_s(lambda: adapter.open(scene, settings).close()) for _ in range(5))
    count = max(STARTS, case.starts)
    starts = [draw_batch(scene, [k]) for k in range(count)]
    with adapter.open(scene, settings) as run:
        loops = [(case.loop or LEAN[case.engine])(run, start) for start in starts]
        gaps = [
            apart(Mechanism.of(scene), run, start, loop)
            for start, loop in zip(starts, loops, strict=True)
        ]
        still = draw_batch(scene, list(range(case.starts))).truncated(0)
        start = median(processor_s(lambda: run.rollout(still)) for _ in range(15))
        batches = [
            draw_batch(scene, list(range(k, k + case.starts))) for k in range(0, count, case.starts)
        ]
        parts = [loops[k : k + case.starts] for k in range(0, count, case.starts)]
        mine, bare = itertools.cycle(batches), itertools.cycle(parts)
        works = [
            lambda: run.rollout(next(mine)),
            lambda: [loop.roll() for loop in next(bare)],
        ]
        times = take_turns(works, REPEATS, PATIENCE, both_s)
    ratios = times[:, 0] / times[:, 1]
    cpu = np.median(times[..., 0], axis=0)
    return Overhead(
        case=case,
        adapter=float(cpu[0]),
        lean=float(cpu[1]),
        ratios=ratios[:, 0],
        wall=float(np.median(ratios[:, 1])),
        load=load,
        start=start,
        apart=max(gaps),
    )


def row(line: Overhead) -> list[str]:
    """Write a line as Markdown."""
    low, middle, high = (value - 1.0 for value in quantiles(line.ratios, n=4))
    mark = "**" if middle > MOST else ""
    return [
        line.case.scene,
        ", ".join(filter(None, (line.case.engine, line.case.note))),
        f"{1e3 * line.adapter:.1f} ms",
        f"{1e3 * line.lean:.1f} ms",
        f"{mark}{middle:+.1%}{mark}",
        f"{low:+.1%} to {high:+.1%}",
        f"{line.wall - 1.0:+.1%}",
        f"{line.apart:.0e}",
        f"{line.load / line.adapter:.1%}",
        f"{line.start / line.adapter:.1%}",
    ]


_COMMAND = "python -m benchmarks.adapter_overhead > reports/adapter-overhead.md"
_TEXT = f"""\
The adapter's rollout over 4 s of one start, in MuJoCo of 10 in one call as data sets make them,
against a lean loop by hand on the same native model with the same inputs and steps (see
`benchmarks/lean_loops.py`), at matched settings. Where steps depend on how near the ground is, or
on how fast joints turn, the loop is told them and the adapter has to find out. Times are the
processor's, medians over at least {REPEATS[0]} turns of each on {STARTS} starts, in one process on
one thread. An overhead above {MOST:.0%} is bold.
"""
_FOOT = """\
- Overhead: adapter over lean loop less 1, the median over turns; of 50 %: what the middle half of
  the turns had; of wall time: the median told by the clock on the wall
- Same to: largest difference of the two trajectories in positions, quaternions and velocities
- Coordinates alone: a loop that keeps MuJoCo's qpos and qvel, and leaves it to others to make
  states of bodies of them. The lean loop of MuJoCo's other lines keeps the bodies' places, turns
  and rates, which MuJoCo works out once a frame for it
- One call of the solver: Exudyn without the new start at each frame, at which its loads jump. It
  makes another trajectory and is no like for like
- Load: building the model, once for all starts; start: what a rollout costs before its first step
  and after its last, with the state reset and nothing built. Both as a part of the adapter's"""


def main(names: list[str]) -> None:
    print_head("What the adapters cost beside their engines", _COMMAND, _TEXT)
    headings = "scene|engine|>adapter|>lean loop|>overhead|>of 50 %|>of wall time|>same to"
    cases = (case for case in CASES if case.scene in (names or SCENES))
    print_table(f"{headings}|>load|>start", (row(measure(case)) for case in cases))
    print(f"\n{_FOOT}")
    engines = [f"{name} {load_adapter(name).version()}" for name in LEAN]
    print_made(f"numpy {np.__version__}", *engines)


if __name__ == "__main__":
    main(sys.argv[1:])
