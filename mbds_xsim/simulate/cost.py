"""What the runs of engines will cost, from a few steps of each beforehand."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from mbds_xsim.base import isolate
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings

_LONG = 120.0
"""A run that takes longer is announced [s]."""
_EACH = 2e-4
"""Longest that a step takes for each body in any engine [s]; the slowest measured is Exudyn in
`particlecar` with 1.4e-4. What is short even so is not worth a look beforehand."""
_STEPS = 50
_PATIENCE = 20.0  # longest that those may take [s]


@dataclass(frozen=True)
class Work:
    """All runs of an engine at some settings."""

    name: str
    engine: str
    settings: Settings
    steps: float
    """Steps of all trajectories and runs together, in steps of the settings' length."""


def forewarnings(
    scene: Scene, start: Batch, work: Sequence[Work], *, workers: int | None
) -> list[str]:
    """Measure what may be long, and give a line for each engine that takes minutes.

    Args:
        scene: What is simulated.
        start: A batch of one.
        work: What is to be done.
        workers: Processes at a time; all cores when left out.
    """
    doubtful = [one for one in work if one.steps * len(scene.bodies) * _EACH > _LONG]
    tasks = [
        Task(_seconds_a_step, (scene, start, one.engine, one.settings), _PATIENCE)
        for one in doubtful
    ]
    answers = zip(doubtful, run_tasks(tasks, workers=workers), strict=True)
    return [line for one, answer in answers if (line := _line(scene, one, answer))]


def _seconds_a_step(scene: Scene, start: Batch, engine: str, settings: Settings) -> float:
    """Time a few steps, however many there are in a frame of the scene [s]."""
    clock = Clock(frame=_STEPS * settings.step, steps=1)
    adapter = registry.load_adapter(engine)
    isolate.begin()
    with adapter.open(msgspec.structs.replace(scene, clock=clock), settings) as run:
        run.rollout(start.truncated(1))
        begin = time.process_time()
        run.rollout(start.truncated(1))
        return (time.process_time() - begin) / _STEPS


def _line(scene: Scene, work: Work, each: float | Crash) -> str:
    """Announce what is long; what crashed or was refused is told by the run itself."""
    if isinstance(each, Crash):
        if not each.timed_out:
            return ""
        duration = f"at least {_duration(work.steps * _PATIENCE / (2 * _STEPS))}"
    elif work.steps * each > _LONG:
        duration = f"about {_duration(work.steps * each)}"
    else:
        return ""
    return (
        f"{work.name} on {scene.name}: {work.steps:.2g} steps of {work.settings.step:.3g} s, "
        f"{duration} of processor time"
    )


def _duration(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
