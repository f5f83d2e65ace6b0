"""One point of a chart: a start simulated at one setting, timed, and held to the reference."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import isolate
from mbds_xsim.checks import Finding, agreement, audit
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, ModelSize, Settings

Array = NDArray[np.float64]
Made = TypeVar("Made")
Seconds = tuple[float, ...]

INSTANT = 1.0
"""Time of the error that is charted, where the reference lasts so long [s]."""

WARM_UP = 2
"""Frames before those that are timed."""
_ENOUGH = 0.2  # of timing [s]
_MOST_REPEATS = 7


@dataclass(frozen=True, eq=False)
class Truth:
    """What one start is held against."""

    trajectory: Trajectory
    growth: Array
    """Sensitivity G, shape (1, frame)."""
    judged: bool = True
    """Whether the error counts against a budget: not where an engine is held to itself."""


@dataclass(frozen=True)
class Timing:
    """Rollouts of one start by one loaded model, one entry a repeat."""

    wall_s: tuple[float, ...]
    """Wall time per simulated second."""
    cpu_s: tuple[float, ...]
    """Processor time per simulated second."""
    setup_s: float


@dataclass(frozen=True)
class Measured:
    """What a point is about; figures of a trajectory that failed are None."""

    version: str
    size: ModelSize
    timing: Timing
    failure: Failure | None
    error_m: float | None
    error_weighted_m: float | None
    gap_m: float | None
    energy: float | None
    broken: tuple[str, ...]


def measure(scene: Scene, start: Batch, engine: str, settings: Settings, truth: Truth) -> Measured:
    """Simulate one start in this process.

    A rollout of two frames goes before the timed ones; short ones are repeated.

    Args:
        scene: What to simulate.
        start: A batch of one.
        engine: Name of the adapter.
        settings: How to step.
        truth: What the motion is held against.

    Raises:
        InputError: The engine cannot do the scene or the settings are not allowed.
    """
    adapter = registry.load_adapter(engine)
    isolate.begin()
    begin = time.perf_counter()
    with adapter.open(scene, settings) as run:
        setup = time.perf_counter() - begin
        run.rollout(start.truncated(WARM_UP))
        duration = scene.clock.frame * start.steps
        trajectory, walls, cpus = timed(lambda: run.rollout(start), duration)
        size = run.size
    failure = trajectory.failures[0]
    found = {} if failure else _findings(scene, start, trajectory, adapter, settings)
    error = agreement.particle_error(Mechanism.of(scene), trajectory, truth.trajectory)
    weighted = agreement.growth_weighted(*_known(error, truth))[0]
    frame = round(horizon_of(truth.trajectory) / scene.clock.frame)
    told = failure is None and frame > 0
    balance = "passivity" if scene.contacts else "energy"
    return Measured(
        version=adapter.version(),
        size=size,
        timing=Timing(walls, cpus, setup),
        failure=failure,
        error_m=float(error[0, frame]) if told else None,
        error_weighted_m=float(weighted) if told else None,
        gap_m=_figure(found, "gap"),
        energy=_figure(found, balance),
        broken=(
            *(_over_budget(scene, truth, error, weighted) if told and truth.judged else ()),
            *(name for name, finding in found.items() if not finding.passed.all()),
        ),
    )


def horizon_of(truth: Trajectory) -> float:
    """Time of the charted error: 1 s, or the last frame that the reference has before [s]."""
    known = np.flatnonzero(np.isfinite(truth.position).all(axis=(0, 2, 3)))
    before = truth.time[known[truth.time[known] <= INSTANT * (1 + 1e-9)]]
    return float(before[-1]) if len(before) else 0.0


def timed(work: Callable[[], Made], duration: float) -> tuple[Made, Seconds, Seconds]:
    """Repeat short work; give what it made last, and wall and processor times.

    Times are per second of the duration that it simulates [s], one entry a repeat.
    """
    walls: list[float] = []
    cpus: list[float] = []
    while not walls or (sum(walls) < _ENOUGH and len(walls) < _MOST_REPEATS):
        wall, cpu = time.perf_counter(), time.process_time()
        made = work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return made, tuple(w / duration for w in walls), tuple(c / duration for c in cpus)


def _known(error: Array, truth: Truth) -> tuple[Array, Array]:
    """Keep the frames that the reference has."""
    known = np.isfinite(truth.trajectory.position).all(axis=(0, 2, 3))
    return error[:, known], truth.growth[:, known]


def _over_budget(scene: Scene, truth: Truth, error: Array, weighted: float) -> Iterator[str]:
    """Name the budgets of accuracy that are not kept."""
    at_instant = np.abs(truth.trajectory.time - INSTANT) < 0.5 * scene.clock.frame
    at_instant &= np.isfinite(truth.trajectory.position).all(axis=(0, 2, 3))
    if not (error[0, at_instant] <= scene.budget.error_1s * scene.length).all():
        yield "error at 1 s"
    if not weighted <= scene.budget.error * scene.length:
        yield "error growth-weighted"


def _findings(
    scene: Scene, start: Batch, trajectory: Trajectory, adapter: Adapter, settings: Settings
) -> dict[str, Finding]:
    """Run all checks."""
    found = audit(
        scene,
        start,
        trajectory,
        adapter.methods[settings.method],
        step=settings.step,
        contact_time=adapter.contact_scales(settings).time,
    )
    return {finding.check: finding for finding in found}


def _figure(findings: dict[str, Finding], check: str) -> float | None:
    """Worst figure of a check, None where it does not apply or has none."""
    figure = float(findings[check].figure[0]) if check in findings else np.nan
    return figure if np.isfinite(figure) else None
