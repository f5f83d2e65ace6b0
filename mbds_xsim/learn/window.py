"""A data set as a few contiguous tensors, and windows gathered from it by index."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import counted
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.graph import Graph, RowBundle
from mbds_xsim.scene.sampling import has_known_forces

HISTORY = 6
"""Number of frames that a model is shown; all rollouts start after them, even if it uses fewer."""

# Inputs that a model may know: `input/force` contains the noise and is never read.
_KNOWN_FORCE, _TORQUE = "input/known_force", "input/torque"
_BODIES = ("body/position", "body/orientation", "body/velocity", "body/angular_velocity")


def names_read(data: Dataset, *, bodies: bool) -> tuple[str, ...]:
    """Return the names of the datasets that `Motions.of` reads from a file.

    Raises InputError if it lacks the known forces that act in its scene.
    """
    forces = (_KNOWN_FORCE,) if _KNOWN_FORCE in data else ()
    if not forces and has_known_forces(data.scene):
        raise InputError(
            f"{data.path}: lacks {_KNOWN_FORCE}, which earlier versions did not write for the "
            "servos of sliders; generate the data again in an empty folder"
        )
    return ("position", "velocity", *forces, _TORQUE, *(_BODIES if bodies else ()))


@dataclass(frozen=True, eq=False)
class KnownInputs(RowBundle):
    """Known forces and torques over a frame, without the noise."""

    force: Tensor
    """Forces on the bodies' centres of mass in W [N], shape (…, body, 3)."""
    torque: Tensor
    """Torques about the hinges, on the child and opposite on the parent [N·m], (…, hinge)."""

    def at(self, frame: int) -> KnownInputs:
        """Take one frame of inputs of shape (batch, frame, …)."""
        return self[:, frame]


@dataclass(frozen=True, eq=False)
class Start(RowBundle):
    """Known part of a motion when its prediction starts."""

    history: Tensor
    """Last positions of the particles in W, oldest first [m], shape (batch, 6, particle, 3)."""
    velocity: Tensor
    """Velocities of the particles at the last known frame [m/s], shape (batch, particle, 3)."""
    body: Tensor | None = None
    """Published states of the bodies at the same frames: position, orientation wxyz, velocity and
    angular velocity, shape (batch, 6, body, 13), float64; None if `Motions` were read without them.
    """


@dataclass(frozen=True, eq=False)
class Sample(RowBundle):
    """Starts, and the frames that follow them."""

    start: Start
    inputs: KnownInputs
    """Inputs over each frame to come, shapes (batch, frame, body, 3) and (batch, frame, hinge)."""
    position: Tensor
    """Positions of the particles in the frames to come [m], shape (batch, frame, particle, 3)."""
    velocity: Tensor
    """Velocities of the particles in the frames to come [m/s], same shape."""
    body: Tensor | None = None
    """Published states of the bodies in these frames, shape (batch, frame, body, 13)."""


@dataclass(frozen=True, eq=False)
class Motions(RowBundle):
    """Trajectories of one part of a data set, on one device."""

    graph: Graph
    split: str
    """Name of the part: train, validation or test."""
    index: NDArray[np.int64]
    """Number of each trajectory, the same in all engines."""
    position: Tensor
    """Positions of the particles in W [m], shape (trajectory, frame, particle, 3)."""
    velocity: Tensor
    """Velocities of the particles in W [m/s], same shape."""
    inputs: KnownInputs
    """Inputs over each step, shapes (trajectory, step, body, 3) and (trajectory, step, hinge)."""
    body: Tensor | None = None
    """Published states of the bodies, shape (trajectory, frame, body, 13), float64."""

    @staticmethod
    def of(
        data: Dataset,
        split: str,
        *,
        rows: NDArray[np.int64] | None = None,
        bodies: bool = False,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Motions:
        """Read the trajectories of a part: "train", "validation" or "test".

        Args:
            data: The file of one engine.
            split: The part.
            rows: Only these trajectories, by row.
            bodies: Whether to read the bodies' states too.
            device: Device of the tensors.
            dtype: Precision of positions, velocities and inputs; the file has float32.

        Raises:
            InputError: The part is missing or empty, its trajectories have too few frames, or known
                forces are missing.
        """
        chosen = data.rows_of(split) if rows is None else np.intersect1d(data.rows_of(split), rows)
        frames = int(data.attributes["steps"]) + 1
        if not len(chosen) or frames <= HISTORY:
            raise InputError(
                f"{data.path}: {counted(len(chosen), 'trajectory')} of {frames} frames for "
                f"{split}, needed are at least 1 of {HISTORY + 1}; generate more"
            )
        names = names_read(data, bodies=bodies)
        graph = Graph.of(data.scene)

        def read(name: str) -> Tensor:
            return torch.from_numpy(data[name][chosen])

        force = torch.zeros(1, 1, 1, 1).expand(len(chosen), frames - 1, graph.body_count, 3)
        force = read(_KNOWN_FORCE) if _KNOWN_FORCE in names else force
        return Motions(
            graph=graph,
            split=split,
            index=data.index[chosen],
            position=graph.embed(read("position").to(dtype)),
            velocity=graph.embed(read("velocity").to(dtype), rest=0.0),
            inputs=KnownInputs(force.to(dtype), read(_TORQUE).to(dtype)),
            body=torch.cat([read(name) for name in _BODIES], dim=-1) if bodies else None,
        ).to(device)

    @staticmethod
    def joined(parts: Sequence[Motions]) -> Motions:
        """Concatenate trajectories of several engines; scene and part must be the same."""
        first = parts[0]
        if any(p.graph.scene != first.graph.scene or p.split != first.split for p in parts):
            msg = "motions of different scenes or parts cannot be joined; load them apart"
            raise InputError(msg)
        bodies = [part.body for part in parts if part.body is not None]
        return replace(
            first,
            index=np.concatenate([part.index for part in parts]),
            position=torch.cat([part.position for part in parts]),
            velocity=torch.cat([part.velocity for part in parts]),
            inputs=KnownInputs(
                torch.cat([part.inputs.force for part in parts]),
                torch.cat([part.inputs.torque for part in parts]),
            ),
            body=torch.cat(bodies) if len(bodies) == len(parts) else None,
        )

    def __getitem__(self, rows: slice | Tensor) -> Motions:
        """Take some of the trajectories."""
        index = self.index[torch.arange(len(self))[rows].numpy()]
        return replace(super().__getitem__(rows), index=index)

    @property
    def frame_count(self) -> int:
        """Number of frames of a trajectory."""
        return self.position.shape[1]

    def until(self, frames: int) -> Motions:
        """Keep at most the first `frames` frames of all trajectories."""
        inputs = self.inputs[:, : frames - 1]
        return replace(self.mapped(lambda values: values[:, :frames], RowBundle), inputs=inputs)

    def window_count(self, horizon: int = 1) -> int:
        """Return the number of windows of `HISTORY` known frames and `horizon` frames to come."""
        return len(self) * max(0, self.frame_count - HISTORY - horizon + 1)

    def take(self, numbers: Tensor, horizon: int = 1) -> Sample:
        """Gather windows by number, counted by trajectory, with `horizon` frames to come each.

        Numbers are from 0 to `window_count(horizon)` − 1, int64, shape (batch,).
        """
        each = self.frame_count - HISTORY - horizon + 1
        row = torch.div(numbers, each, rounding_mode="floor")
        return self.sample(row, numbers % each + HISTORY - 1, horizon)

    def draw(self, count: int, generator: torch.Generator, horizon: int = 1) -> Sample:
        """Draw windows uniformly with replacement; the generator must be on the CPU."""
        numbers = torch.randint(self.window_count(horizon), (count,), generator=generator)
        return self.take(numbers.to(self.position.device), horizon)

    def sample(self, row: Tensor, last: Tensor | int, horizon: int) -> Sample:
        """Gather windows by trajectory and by last known frame, (batch,) or one for all."""
        row, last = row[:, None], (torch.zeros_like(row) + last)[:, None]
        past = last + torch.arange(1 - HISTORY, 1, device=row.device)
        steps = last + torch.arange(horizon, device=row.device)
        return Sample(
            start=Start(
                history=self.position[row, past],
                velocity=self.velocity[row, last][:, 0],
                body=None if self.body is None else self.body[row, past],
            ),
            inputs=self.inputs[row, steps],
            position=self.position[row, steps + 1],
            velocity=self.velocity[row, steps + 1],
            body=None if self.body is None else self.body[row, steps + 1],
        )
