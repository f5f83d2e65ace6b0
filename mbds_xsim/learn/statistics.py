"""Means and deviations that models normalise by: of training trajectories, never of others."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from mbds_xsim.errors import InputError
from mbds_xsim.learn.channels import CHANNELS, Channels
from mbds_xsim.learn.window import Inputs, Motions

__all__ = ["Moments", "Statistics"]

_ROWS = 64  # trajectories at a time
_NEGLIGIBLE = 1e-9  # of the scene's length: a deviation that is rounding


@dataclass(frozen=True, eq=False)
class Moments:
    """Of a vector: mean and standard deviation per axis, shape (3,), float64."""

    mean: Tensor
    std: Tensor
    """1 where it does not vary."""

    def spread(self, moving: Tensor) -> float:
        """Root mean square of the deviations along some axes, of those that vary at all.

        Args:
            moving: Along which a scene moves, bool, shape (3,).
        """
        varying = moving.to(self.std.device) & (self.std != 1.0)
        chosen = self.std[varying if varying.any() else moving.to(self.std.device)]
        return float(chosen.square().mean().sqrt())

    def isotropic(self, up: Tensor) -> Moments:
        """One deviation for all axes, and only the mean along gravity: what turns with the frame.

        Args:
            up: Direction of gravity, any length, shape (3,); all zeros where there is none.
        """
        axis = torch.nn.functional.normalize(up, dim=0)
        varying = self.std != 1.0
        mean = (self.mean @ axis) * axis
        square = (self.std**2 + (self.mean - mean) ** 2)[varying]
        std = torch.sqrt(square.mean()) if len(square) else torch.ones(()).to(square)
        return Moments(mean, std.expand(3).clone())


@dataclass(frozen=True, eq=False)
class Statistics:
    """Of the particles, over all training trajectories and frames."""

    position: Moments
    """[m]"""
    displacement: Moments
    """From a frame to the next [m]."""
    acceleration: Moments
    """Second differences of positions [m]."""
    channels: Tensor
    """Root mean square size of each of `CHANNELS` where it acts [N, N·m]; 1 where none does."""

    @staticmethod
    def of(motions: Motions) -> Statistics:
        """Compute them.

        Raises:
            InputError: The trajectories are not those for training.
        """
        if motions.split != "train":
            msg = f"statistics: got the part {motions.split!r}, allowed is 'train'"
            raise InputError(msg)
        floor = _NEGLIGIBLE * motions.graph.length
        return Statistics(
            position=_moments(motions, 0, floor),
            displacement=_moments(motions, 1, floor),
            acceleration=_moments(motions, 2, floor),
            channels=_sizes(motions),
        )

    def isotropic(self, gravity: Tensor) -> Statistics:
        """Give statistics that commute with turns about gravity."""
        moments = {
            name: getattr(self, name).isotropic(gravity.to(self.channels))
            for name in ("position", "displacement", "acceleration")
        }
        return dataclasses.replace(self, **moments)

    def to_state(self) -> dict[str, Tensor]:
        """Give plain tensors to store with a model."""
        return {
            "channels": self.channels,
            **{
                f"{name}.{key}": getattr(getattr(self, name), key)
                for name in ("position", "displacement", "acceleration")
                for key in ("mean", "std")
            },
        }

    @staticmethod
    def from_state(state: dict[str, Tensor]) -> Statistics:
        """Read what `to_state` gave."""
        position, displacement, acceleration = (
            Moments(state[f"{name}.mean"], state[f"{name}.std"])
            for name in ("position", "displacement", "acceleration")
        )
        return Statistics(position, displacement, acceleration, state["channels"])


def _moments(motions: Motions, order: int, floor: float) -> Moments:
    """Moments of differences of an order; two passes, so that large means cost no digits."""
    count = 0
    total = torch.zeros(3, dtype=torch.float64)
    for values in _differences(motions, order):
        total += values.sum((0, 1, 2)).cpu()
        count += values[..., 0].numel()
    mean = total / count
    square = torch.zeros(3, dtype=torch.float64)
    for values in _differences(motions, order):
        square += ((values - mean.to(values.device)) ** 2).sum((0, 1, 2)).cpu()
    std = torch.sqrt(square / count)
    return Moments(mean, torch.where(std > floor, std, 1.0))


def _differences(motions: Motions, order: int) -> Iterator[Tensor]:
    for k in range(0, len(motions), _ROWS):
        part = motions.position[k : k + _ROWS].double()
        yield part.diff(n=order, dim=1) if order else part


def _sizes(motions: Motions) -> Tensor:
    channels = Channels(motions.graph).to(motions.position.device)
    square = torch.zeros(len(CHANNELS), dtype=torch.float64)
    acting = torch.zeros(len(CHANNELS), dtype=torch.float64)
    for k in range(0, len(motions), _ROWS):
        part = slice(k, k + _ROWS)
        inputs = Inputs(motions.inputs.force[part].float(), motions.inputs.torque[part].float())
        vectors = channels(motions.position[part, :-1].float(), inputs).double()
        square += (vectors**2).sum((0, 1, 2, 4)).cpu()
        acting += (vectors != 0).any(-1).sum((0, 1, 2)).cpu()
    return torch.where(acting > 0, torch.sqrt(square / acting.clamp(min=1)), 1.0)
