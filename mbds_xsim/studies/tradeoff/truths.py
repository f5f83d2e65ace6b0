"""What motions are held against: the reference, or where it knows nothing, a method's own limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.reference import FirstImpact
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.simulator import Simulator
from mbds_xsim.studies.tradeoff.sweep import SPAN

INSTANT = 1.0
"""Time of the error that is charted, where the reference lasts so long [s]."""
LIMIT_COUNT = 2 * SPAN
"""Steps a frame that stand for a vanishing step."""

_GRACE = 30.0
_PATIENCE = 5.0

Place = tuple[str, str, int]
"""Engine, method and row of the batch."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What one start is held against."""

    trajectory: Trajectory
    growth: Array
    """Sensitivity G, shape (1, frame)."""
    judged: bool = True
    """Whether the error counts against a budget: not where an engine is held to itself."""

    @property
    def known(self) -> Mask:
        """Whether each frame is known, shape (frame,)."""
        return np.asarray(np.isfinite(self.trajectory.position).all(axis=(0, 2, 3)))

    @property
    def horizon(self) -> float:
        """Time of the charted error: 1 s, or the last frame that is known before [s]."""
        times = self.trajectory.time[self.known]
        before = times[times <= INSTANT * (1 + 1e-9)]
        return float(before[-1]) if len(before) else 0.0


@dataclass
class Truths:
    """Truth of each start, or of each start in each method."""

    scene: Scene
    batch: Batch
    references: list[Truth]
    usual: Mapping[tuple[str, str], Simulator]
    """By engine and method, at the engine's usual options."""
    limit: float
    """Longest rollout of one start that was asked for [s]."""
    workers: int | None
    _limits: dict[Place, Truth] = field(default_factory=dict)

    @property
    def are_limits(self) -> bool:
        """Whether the reference ends at once, so that a method only has itself to be held to."""
        return min(truth.horizon for truth in self.references) == 0.0

    @property
    def horizon(self) -> float:
        """Time of the charted error, the earliest of all starts [s]."""
        if self.are_limits:
            return min(INSTANT, self.scene.clock.duration)
        return min(truth.horizon for truth in self.references)

    def prepare(self, places: Sequence[Place]) -> None:
        """Simulate the limits that will be asked for and are not there."""
        if not self.are_limits:
            return
        missing = [place for place in dict.fromkeys(places) if place not in self._limits]
        tasks = [
            Task(
                _limit,
                (self.usual[engine, method], self.scene, self.batch[[start]]),
                _GRACE + _PATIENCE * self.limit,
            )
            for engine, method, start in missing
        ]
        for place, answer in zip(missing, run_tasks(tasks, workers=self.workers), strict=True):
            self._limits[place] = self._unknown() if isinstance(answer, Crash) else answer

    def of(self, place: Place) -> Truth:
        """Give what one start in one method is held against."""
        return self._limits[place] if self.are_limits else self.references[place[2]]

    def _unknown(self) -> Truth:
        """Give what nothing can be held against."""
        time = self.references[0].trajectory.time
        return _own_limit(Trajectory.empty(time, 1, len(self.scene.bodies)))


def references(scene: Scene, batch: Batch, *, cache: bool, workers: int | None) -> list[Truth]:
    """Solve the reference of each start.

    Raises:
        InputError: It failed; without it no error can be measured.
    """
    solved = run_references(scene, batch, cache=cache, workers=workers)
    each = (solved[[k]] for k in range(len(batch)))
    return [Truth(one.trajectory, one.growth) for one in each]


def first_impact(truths: Sequence[Truth]) -> float | None:
    """Time of the first impact after which a motion has no unique solution [s]."""
    ends = [truth.trajectory.failures[0] for truth in truths]
    return min((end.time for end in ends if isinstance(end, FirstImpact)), default=None)


def _limit(simulator: Simulator, scene: Scene, start: Batch) -> Truth:
    motion = simulator.simulate(scene, start, LIMIT_COUNT, None, often=False).motion
    assert isinstance(motion, Trajectory)  # those without bodies need a reference
    return _own_limit(motion)


def _own_limit(motion: Trajectory) -> Truth:
    return Truth(motion, np.ones((1, len(motion.time))), judged=False)
