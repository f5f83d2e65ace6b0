"""Outcomes of the simulations of a validation, before they are judged."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mbds_xsim.base.arrays import Array, Picked
from mbds_xsim.base.isolate import Crash
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import Simulation


@dataclass
class Outcome:
    """Simulations of a scene's starts by one contender."""

    contender: Contender
    scene: Scene
    batch: Batch
    parts: list[Simulation | Crash] = field(default_factory=list)
    rows: list[list[int]] = field(default_factory=list)
    """Rows of the batch in each part."""
    sample: list[int] = field(default_factory=list)
    """Rows of the batch that run at other steps too, for the consistency check."""
    other_steps: dict[float, Trajectory] = field(default_factory=dict)
    """Trajectories of the sample at other steps, by step [s]."""

    @property
    def method(self) -> Method:
        """Method by which the engine steps, with its claims."""
        return load_adapter(self.contender.engine).methods[self.contender.settings.method]

    def keep_step(self, step: float, answer: Simulation | Crash) -> None:
        """Store the sample's run at another step [s]; if it crashed, NaN with the reason."""
        frames, count = np.arange(self.batch.steps + 1.0), len(self.sample)
        if isinstance(answer, Simulation):
            self.other_steps[step] = answer.trajectory.padded(frames)
        else:
            lost = Failure(0, answer.reason)
            bodies = len(self.scene.bodies)
            self.other_steps[step] = Trajectory.empty(frames, count, bodies, lost)

    @property
    def ran(self) -> list[tuple[list[int], Simulation]]:
        """Parts that did not crash, each with its rows of the batch; none before they have run."""
        pairs = zip(self.rows, self.parts, strict=False)
        return [(rows, part) for rows, part in pairs if isinstance(part, Simulation)]

    @property
    def simulations(self) -> list[Simulation]:
        """Parts that did not crash."""
        return [part for _, part in self.ran]

    def trajectory(self, time: Array) -> Trajectory | None:
        """Put the parts together; rows of a crashed part are NaN. Return None if all crashed."""
        if not self.ran:
            return None
        whole = Trajectory.empty(time, len(self.batch), len(self.scene.bodies))
        for rows, part in self.ran:
            whole = whole.replaced(np.array(rows), part.trajectory)
        return whole

    @property
    def failures(self) -> list[str]:
        """One line for each crash, and for each trajectory that ended early."""
        crashes = dict.fromkeys(p.reason for p in self.parts if isinstance(p, Crash))
        lines = [f"crash: {reason}" for reason in crashes]
        for rows, part in self.ran:
            for row, failure in zip(rows, part.trajectory.failures, strict=True):
                if failure is not None:
                    where = f"{self.batch.label(row)} ended at frame {failure.frame}"
                    lines.append(f"{where}: {failure.reason}")
        return lines


@dataclass(frozen=True, eq=False)
class ReferenceOutcome(Picked):
    """Reference solution of all trajectories."""

    trajectory: Trajectory
    """Reference motion; NaN from the first impact without a unique solution on."""
    growth: Array
    """Sensitivity G, shape (trajectory, frame); NaN where the trajectory is NaN."""
    rtol: float
    cached: int
    busy_s: float
    """Time taken to solve it [s]."""
