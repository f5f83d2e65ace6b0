"""A data set as few contiguous tensors, and windows of it gathered by index."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbds_xsim.dataset.read import Dataset
from mbds_xsim.errors import InputError
from mbds_xsim.learn.graph import Graph

__all__ = ["HISTORY", "Inputs", "Motions", "Sample", "Start", "names_read"]

HISTORY = 6
"""Positions that a model is shown; all rollouts start behind as many, whatever a model uses."""

_PARTICLES = ("position", "velocity")
# What a model may be told: `input/force` has the noise in it and is never read.
_KNOWN_FORCE, _TORQUE = "input/known_force", "input/torque"
_BODIES = ("body/position", "body/orientation", "body/velocity", "body/angular_velocity")


def names_read(*, bodies: bool) -> tuple[str, ...]:
    """Name the datasets that `Motions.of` reads."""
    return (*_PARTICLES, _KNOWN_FORCE, _TORQUE, *(_BODIES if bodies else ()))


@dataclass(frozen=True, eq=False)
class Inputs:
    """What acts over a frame and is known: never the noise."""

    force: Tensor
    """On the bodies' centres of mass in W [N], shape (…, body, 3)."""
    torque: Tensor
    """About the hinges, on the child and the opposite on the parent [N·m], shape (…, hinge)."""

    def at(self, frame: int) -> Inputs:
        """Take one frame of inputs of shape (batch, frame, …)."""
        return Inputs(self.force[:, frame], self.torque[:, frame])

    def __getitem__(self, rows: slice | Tensor) -> Inputs:
        """Take some rows of a batch."""
        return Inputs(self.force[rows], self.torque[rows])


@dataclass(frozen=True, eq=False)
class Start:
    """What is known of a motion when its prediction starts."""

    history: Tensor
    """The last positions of the particles in W, oldest first [m], shape (batch, 6, particle, 3)."""
    velocity: Tensor
    """Of the particles at the last of them [m/s], shape (batch, particle, 3)."""
    body: Tensor | None = None
    """Published states of the bodies then: position, orientation wxyz, velocity and angular
    velocity, shape (batch, body, 13), float64; only where `Motions` were read with them."""

    def __len__(self) -> int:
        return len(self.history)

    def __getitem__(self, rows: slice | Tensor) -> Start:
        """Take some rows of a batch."""
        body = None if self.body is None else self.body[rows]
        return Start(self.history[rows], self.velocity[rows], body)


@dataclass(frozen=True, eq=False)
class Sample:
    """Starts, and what followed."""

    start: Start
    inputs: Inputs
    """Over each frame to come, shapes (batch, frame, body, 3) and (batch, frame, hinge)."""
    position: Tensor
    """Of the particles in the frames to come [m], shape (batch, frame, particle, 3)."""
    velocity: Tensor
    """The same [m/s]."""

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True, eq=False)
class Motions:
    """Trajectories of one part of a data set, on one device."""

    graph: Graph
    split: str
    """Which part it is: train, validation or test."""
    index: NDArray[np.int64]
    """Number of each trajectory, the same in all engines."""
    position: Tensor
    """Of the particles in W [m], shape (trajectory, frame, particle, 3)."""
    velocity: Tensor
    """The same [m/s]."""
    inputs: Inputs
    """Over each step, shapes (trajectory, step, body, 3) and (trajectory, step, hinge)."""
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
        """Read the trajectories of a part.

        Args:
            data: The file of one engine.
            split: Its part: "train", "validation" or "test".
            rows: Only these trajectories, by row.
            bodies: Whether to read the bodies' states too.
            device: Where to put them.
            dtype: Of positions, velocities and inputs; the file has float32.

        Raises:
            InputError: There is no such part or it is empty, or the frames are too few.
        """
        chosen = data.rows_of(split) if rows is None else np.intersect1d(data.rows_of(split), rows)
        frames = int(data.attributes["steps"]) + 1
        if not len(chosen) or frames <= HISTORY:
            msg = (
                f"{data.path}: {len(chosen)} trajectories of {frames} frames for {split}, needed "
                f"are at least 1 of {HISTORY + 1}; generate more"
            )
            raise InputError(msg)
        graph = Graph.of(data.scene)

        def read(name: str) -> Tensor:
            return torch.from_numpy(np.stack([data[name][int(row)] for row in chosen]))

        return Motions(
            graph=graph,
            split=split,
            index=data.index[chosen],
            position=graph.embed(read("position").to(dtype)),
            velocity=graph.embed(read("velocity").to(dtype), rest=0.0),
            inputs=_inputs(data, chosen, dtype),
            body=_bodies(data, chosen) if bodies else None,
        ).to(device)

    @staticmethod
    def joined(parts: Sequence[Motions]) -> Motions:
        """Put trajectories of several engines behind each other; scene and part must be one.

        Raises:
            InputError: They are of different scenes or parts.
        """
        first = parts[0]
        if any(p.graph.scene != first.graph.scene or p.split != first.split for p in parts):
            msg = "motions of different scenes or parts cannot be joined; load them apart"
            raise InputError(msg)
        bodies = [part.body for part in parts if part.body is not None]
        return Motions(
            graph=first.graph,
            split=first.split,
            index=np.concatenate([part.index for part in parts]),
            position=torch.cat([part.position for part in parts]),
            velocity=torch.cat([part.velocity for part in parts]),
            inputs=Inputs(
                torch.cat([part.inputs.force for part in parts]),
                torch.cat([part.inputs.torque for part in parts]),
            ),
            body=torch.cat(bodies) if len(bodies) == len(parts) else None,
        )

    def to(self, device: torch.device | str) -> Motions:
        """Move everything to a device."""
        return Motions(
            graph=self.graph.to(device),
            split=self.split,
            index=self.index,
            position=self.position.to(device),
            velocity=self.velocity.to(device),
            inputs=Inputs(self.inputs.force.to(device), self.inputs.torque.to(device)),
            body=None if self.body is None else self.body.to(device),
        )

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: slice | Tensor) -> Motions:
        """Take some of the trajectories."""
        chosen = torch.arange(len(self))[rows]
        return Motions(
            graph=self.graph,
            split=self.split,
            index=self.index[chosen.numpy()],
            position=self.position[rows],
            velocity=self.velocity[rows],
            inputs=self.inputs[rows],
            body=None if self.body is None else self.body[rows],
        )

    @property
    def frame_count(self) -> int:
        """Frames of a trajectory."""
        return self.position.shape[1]

    def window_count(self, horizon: int = 1) -> int:
        """How many windows of `HISTORY` frames and so many to come there are."""
        return len(self) * max(0, self.frame_count - HISTORY - horizon + 1)

    def take(self, numbers: Tensor, horizon: int = 1) -> Sample:
        """Gather windows by number, counted trajectory by trajectory.

        Args:
            numbers: From 0 to `window_count(horizon)` − 1, int64, shape (batch,).
            horizon: Frames to come.
        """
        each = self.frame_count - HISTORY - horizon + 1
        row = torch.div(numbers, each, rounding_mode="floor")
        return self.sample(row, numbers % each + HISTORY - 1, horizon)

    def draw(self, count: int, generator: torch.Generator, horizon: int = 1) -> Sample:
        """Draw windows, uniformly and with repetition; the generator is one of the CPU."""
        numbers = torch.randint(self.window_count(horizon), (count,), generator=generator)
        return self.take(numbers.to(self.position.device), horizon)

    def sample(self, row: Tensor, last: Tensor, horizon: int) -> Sample:
        """Gather windows by trajectory and by the last frame that is known, both (batch,)."""
        row, last = row[:, None], last[:, None]
        past = last + torch.arange(1 - HISTORY, 1, device=last.device)
        steps = last + torch.arange(horizon, device=last.device)
        return Sample(
            start=Start(
                history=self.position[row, past],
                velocity=self.velocity[row, last][:, 0],
                body=None if self.body is None else self.body[row, last][:, 0],
            ),
            inputs=Inputs(self.inputs.force[row, steps], self.inputs.torque[row, steps]),
            position=self.position[row, steps + 1],
            velocity=self.velocity[row, steps + 1],
        )


def _inputs(data: Dataset, rows: NDArray[np.int64], dtype: torch.dtype) -> Inputs:
    bodies, steps = len(data.scene.bodies), int(data.attributes["steps"])
    force = torch.zeros(1, 1, 1, 1).expand(len(rows), steps, bodies, 3)
    if _KNOWN_FORCE in data:
        force = _stacked(data, _KNOWN_FORCE, rows)
    torque = _stacked(data, _TORQUE, rows)
    return Inputs(force.to(dtype), torque.to(dtype))


def _bodies(data: Dataset, rows: NDArray[np.int64]) -> Tensor:
    return torch.cat([_stacked(data, name, rows) for name in _BODIES], dim=-1)


def _stacked(data: Dataset, name: str, rows: NDArray[np.int64]) -> Tensor:
    return torch.from_numpy(data[name][rows])
