"""What LGNN and HGNN share: coordinates, the learned energy, training through the integrator.

A state is (batch, 2, node, 3): nodes and their velocities (LGNN) or momenta (HGNN). Both learn from
the frames that all models learn from: the next frame that their integrator reaches is compared,
never an engine's accelerations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from mbds_xsim.dataset.points import Points
from mbds_xsim.learn.energy_network import Drag, EnergyNetwork, EnergyShape
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.mechanics import Mechanics
from mbds_xsim.learn.model import FlowModel
from mbds_xsim.learn.recipe import Cosine, Plateau, Recipe
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import Sample, Start

__all__ = ["EnergyModel", "EnergySettings"]


class EnergySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of LGNN and HGNN."""

    shape: EnergyShape = EnergyShape()
    drag: bool = True
    """Whether a drag is learned beside the energy."""
    substeps: int = 2
    """Runge-Kutta steps in a frame."""
    floor: float | None = None
    """Error below which windows count alike, in the loss's unit. With it a window's error e counts
    as log(1 + e / floor) − log(1 + e): by its ratio, and ever less beyond 1, where no step of the
    integrator resolves the motion. Left out, the loss is the mean of e."""
    recipe: Recipe = Recipe(rate=1e-3, batch=100, skip=True)


class EnergyModel(FlowModel):
    """Motion that follows from a learned energy and the scene's constraints."""

    dtype: ClassVar[torch.dtype] = torch.float64
    needs_bodies: ClassVar[bool] = True
    tracks: ClassVar[Mapping[str, EnergySettings]] = {
        # The authors' own code trains unclipped and sets gradients that are no numbers to zero.
        "paper": EnergySettings(
            EnergyShape(width=200), recipe=Recipe(schedule=Plateau(), skip=True)
        ),
        "native": EnergySettings(),
        # Errors of windows span four decades, from slow motions to whips, which have gradients
        # 1e5 times the others' and of no meaning. Clipping the mean's length keeps its direction,
        # on which Adam then goes on for long.
        "lite": EnergySettings(
            EnergyShape(width=16),
            substeps=1,
            floor=1e-4,
            recipe=Recipe(rate=1e-2, schedule=Cosine(), clip=1.0, skip=True),
        ),
    }

    reference: Tensor
    carrier: Tensor
    carried: Tensor
    particle_map: Tensor
    spread: Tensor

    def __init__(self, graph: Graph, statistics: Statistics, settings: EnergySettings) -> None:
        super().__init__(graph, statistics, settings)
        self.mechanics = Mechanics(graph.scene)
        self.substeps, self.floor = settings.substeps, settings.floor
        self.energy = EnergyNetwork(self.mechanics, settings.shape)
        self.drag = Drag(self.energy, settings.shape) if settings.drag else None
        points, mechanism = self.mechanics.points, self.mechanics.mechanism
        body, offset = points.carrier
        seen = Points.of(graph.scene)
        weights = [
            points.of_body(int(k)).weights(place, points.count)
            for k, place in zip(seen.body, seen.offset, strict=True)
        ]
        for name, values in (
            ("reference", mechanism.reference_orientation),
            ("carrier", body),
            ("carried", offset),
            ("particle_map", np.array(weights)),
            ("spread", statistics.acceleration.spread(graph.moving)),
        ):
            self.register_buffer(name, torch.as_tensor(values), persistent=name == "spread")
        self.double()

    def begin(self, start: Start) -> Tensor:
        """Give nodes and velocities or momenta, on the constraints; see `Model`."""
        assert start.body is not None
        body = start.body.double()
        position, orientation = body[..., :3], body[..., 3:7]
        velocity, spin = body[..., 7:10], body[..., 10:]
        native = _multiply(orientation, self.reference * self.reference.new_tensor([1, -1, -1, -1]))
        arm = _rotate(native[:, self.carrier], self.carried)
        moving = velocity[:, self.carrier] + torch.linalg.cross(spin[:, self.carrier], arm)
        q, v = self.mechanics.project(position[:, self.carrier] + arm, moving)
        return torch.stack([q, self.conjugate(v)], dim=1)

    def positions(self, state: Tensor) -> Tensor:
        """See `Model`."""
        return self.particle_map @ self.mechanics.all_nodes(state[:, 0])

    def velocities(self, state: Tensor) -> Tensor:
        """Velocities of the particles [m/s], shape (batch, particle, 3)."""
        return self.particle_map[:, : self.mechanics.free] @ self.moving(state)

    def conjugate(self, v: Tensor) -> Tensor:
        """What the state has for velocities of the nodes, shape (batch, node, 3)."""
        return v

    def moving(self, state: Tensor) -> Tensor:
        """Velocities of the nodes [m/s], shape (batch, node, 3)."""
        return state[:, 1]

    def settle(self, state: Tensor) -> Tensor:
        """Put a state back onto the constraints (of least mass-weighted change)."""
        q, v = self.mechanics.project(state[:, 0], self.moving(state))
        return torch.stack([q, self.conjugate(v)], dim=1)

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        """Mean square error of positions and of velocities times the frame, in units of second
        differences of positions; `EnergySettings.floor` says how windows are weighed.
        """
        del generator
        state = self.begin(sample.start)
        total = state.new_zeros(len(state))
        frames = sample.position.shape[1]
        for frame in range(frames):
            state = self.advance(state, sample.inputs.at(frame))
            away = self.positions(state) - sample.position[:, frame]
            faster = self.graph.frame_s * (self.velocities(state) - sample.velocity[:, frame])
            total = total + (away**2 + faster**2).mean((1, 2))
        error = total / (frames * self.spread**2)
        if self.floor is None:
            return error.mean()
        return (torch.log1p(error / self.floor) - torch.log1p(error)).mean()


def _multiply(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product of quaternions wxyz."""
    real = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdim=True)
    turned = torch.linalg.cross(p[..., 1:], q[..., 1:].expand_as(p[..., 1:]))
    return torch.cat([real, p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + turned], -1)


def _rotate(q: Tensor, v: Tensor) -> Tensor:
    v = v.expand_as(q[..., 1:])
    twice = 2.0 * torch.linalg.cross(q[..., 1:], v)
    return v + q[..., :1] * twice + torch.linalg.cross(q[..., 1:], twice)
