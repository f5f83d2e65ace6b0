"""LGNN and HGNN: motion from a learned Lagrangian or Hamiltonian and the scene's constraints.

A state is (batch, 2, node, 3): nodes and their velocities (LGNN) or momenta (HGNN). Both learn from
the same frames as all models: the loss compares the next frame that their integrator reaches, never
an engine's accelerations.

LGNN, L = T(q̇) − V(q) (Bhattoo et al., NeurIPS 2022): M q̈ = −∂V/∂q + F + drag − Aᵀ λ with
A q̈ = −Ȧ q̇, A from the scene's joints. T depends on velocities alone, so that Coriolis terms
vanish and M = ∂²T/∂q̇² has a closed form.

HGNN, H = T(p) + V(q) (Bishnoi et al., ICLR 2023): the canonical equations are projected on the
constraints φ = 0 and A u = 0 with Dirac's bracket, ż = J (∇H + Φᵀ Λ), Φ the Jacobian of both by
(q, p). Its block structure leaves two solves with A M⁻¹ Aᵀ. T is a function of u = M⁻¹ p with the
scene's known mass matrix, so of |p_i|² / m_i² where masses are uncoupled: in u, rods couple only
neighbours; in p they would not.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from mbds_xsim.base import bounds, rotation
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.dataset.points import Points
from mbds_xsim.learn.energy import (
    Drag,
    EnergyNetwork,
    EnergyShape,
    MassMatrix,
    NodeEnergy,
    momentum,
    potential_force,
)
from mbds_xsim.learn.graph import Graph, instead
from mbds_xsim.learn.layers import keep, mixed
from mbds_xsim.learn.mechanics import Mechanics, constrained
from mbds_xsim.learn.model import FlowModel
from mbds_xsim.learn.recipe import Cosine, Plateau, Recipe
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs, Sample, Start


class EnergySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of LGNN and HGNN."""

    shape: EnergyShape = EnergyShape()
    drag: bool = True
    """Whether a drag is learned in addition to the energy."""
    substeps: int = 2
    """Number of Runge-Kutta steps per frame."""
    floor: float | None = None
    """Error below which windows count alike, in the loss's unit. With it a window's error e counts
    as log(1 + e / floor) − log(1 + e): by its logarithm, and ever less beyond 1, where no step of
    the integrator resolves the motion. None: the loss is the mean of e."""
    recipe: Recipe = Recipe(rate=1e-3, batch=100, skip=True)

    def __post_init__(self) -> None:
        bounds.at_least_one("substeps", self.substeps)


class NodeDynamics(nn.Module, ABC):
    """Equations of motion of nodes, from an energy; states hold velocities or momenta."""

    def __init__(self, energy: NodeEnergy, drag: nn.Module | None = None) -> None:
        super().__init__()
        self.energy, self.drag = energy, drag
        self.mechanics = energy.mechanics

    def load(self, q: Tensor, v: Tensor, inputs: KnownInputs) -> Tensor:
        """Return all but constraint forces on the free nodes [N], shape (batch, node, 3)."""
        load = potential_force(self.energy, q) + self.mechanics.applied(q, v, inputs)
        return load if self.drag is None else load + self.drag(v)

    def conjugate(self, v: Tensor) -> Tensor:
        """Convert velocities v of the nodes [m/s] to a state's quantity, shape (batch, node, 3)."""
        return v

    def velocity(self, x: Tensor) -> Tensor:
        """Undo `conjugate`."""
        return x

    @abstractmethod
    def derivative(self, q: Tensor, x: Tensor, inputs: KnownInputs) -> tuple[Tensor, Tensor]:
        """Return rates of nodes q [m] and of velocities or momenta x, each (batch, node, 3)."""


class Lagrangian(NodeDynamics):
    """Lagrangian equations of motion, in nodes and velocities."""

    def derivative(self, q: Tensor, x: Tensor, inputs: KnownInputs) -> tuple[Tensor, Tensor]:
        mechanics, load = self.mechanics, self.load(q, x, inputs)
        mass, jacobian = MassMatrix(self.energy, x), mechanics.jacobian(q)
        return x, constrained(mass, load, jacobian, mechanics.bias(x), mechanics.redundant)


class Hamiltonian(NodeDynamics):
    """Hamiltonian equations of motion, in nodes and momenta."""

    def conjugate(self, v: Tensor) -> Tensor:
        return mixed(self.mechanics.mass, v)

    def velocity(self, x: Tensor) -> Tensor:
        """Return u = M⁻¹ p, to which the learned ∂H/∂p tends as training goes on."""
        return mixed(self.mechanics.mass_inverse, x)

    def derivative(self, q: Tensor, x: Tensor, inputs: KnownInputs) -> tuple[Tensor, Tensor]:
        mechanics = self.mechanics
        u = self.velocity(x)
        jacobian, rate = mechanics.jacobian(q), mechanics.jacobian_rate(u)
        solver = mechanics.factored(jacobian)
        slope = momentum(mechanics, self.energy.kinetic(u), u)
        q_rate = mixed(mechanics.mass_inverse, slope)
        second = -solver(jacobian.along(q_rate))
        q_rate = q_rate + mixed(mechanics.mass_inverse, jacobian.back(second))
        p_rate = self.load(q, q_rate, inputs) - rate.back(second)
        first = solver(rate.along(q_rate) + jacobian.along(mixed(mechanics.mass_inverse, p_rate)))
        return q_rate, p_rate - jacobian.back(first)


class EnergyModel(FlowModel):
    """Model whose motion follows from a learned energy and the scene's constraints."""

    kind: ClassVar[type[NodeDynamics]]
    dtype: ClassVar[torch.dtype] = torch.float64
    needs_bodies: ClassVar[bool] = True
    tracks: ClassVar[Mapping[str, EnergySettings]] = {
        # The authors' own code does not clip gradients and sets those that are not finite to zero.
        "paper": EnergySettings(
            EnergyShape(width=200), recipe=Recipe(schedule=Plateau(), skip=True)
        ),
        "native": EnergySettings(),
        # Errors of windows span four decades, from slow motions to whips, whose gradients are 1e5
        # times as large and meaningless. Clipping the length of the mean gradient keeps its
        # direction, which Adam then follows for long.
        "lite": EnergySettings(
            EnergyShape(width=16),
            substeps=1,
            floor=1e-4,
            recipe=Recipe(rate=1e-2, schedule=Cosine(), clip=1.0, skip=True),
        ),
    }

    def __init__(self, graph: Graph, statistics: Statistics, settings: EnergySettings) -> None:
        super().__init__(graph, statistics, settings)
        if graph.scene.contacts:
            raise Unsupported(
                f"scene {graph.scene.name!r}: got {len(graph.scene.contacts)} contact spheres, "
                "allowed are none: HGNN and LGNN hold smooth forces and two-sided constraints; "
                + instead(graph.scene, "hgnn+", "lgnn+")
            )
        self.mechanics = Mechanics(graph.scene)
        self.substeps, self.floor = settings.substeps, settings.floor
        self.energy = EnergyNetwork(self.mechanics, settings.shape)
        self.drag = Drag(self.energy, settings.shape) if settings.drag else None
        self.dynamics = self.kind(self.energy, self.drag)
        points, mechanism = self.mechanics.points, self.mechanics.mechanism
        body, offset = points.carrier
        particles = Points.of(graph.scene)
        weights = [
            points.of_body(int(k)).weights(place, points.count)
            for k, place in zip(particles.body, particles.offset, strict=True)
        ]
        # Offsets in the published frames, because starts give orientations of those.
        carried = rotation.rotate(rotation.conjugate(mechanism.reference_orientation)[body], offset)
        keep(self, carrier=body, carried=carried, particle_map=np.array(weights))
        spread = statistics.acceleration.spread(graph.moving)
        self.register_buffer("spread", torch.as_tensor(spread))
        self.double()

    def begin(self, start: Start) -> Tensor:
        """Return nodes and velocities or momenta, on the constraints."""
        assert start.body is not None
        q, v = self.mechanics.placed(start.body[:, -1, self.carrier].double(), self.carried)
        return torch.stack([q, self.dynamics.conjugate(v)], dim=1)

    def positions(self, state: Tensor) -> Tensor:
        return self.particle_map @ self.mechanics.all_nodes(state[:, 0])

    def velocities(self, state: Tensor) -> Tensor:
        """Return the velocities of the particles [m/s], shape (batch, particle, 3)."""
        node_velocity = self.dynamics.velocity(state[:, 1])
        return self.particle_map[:, : self.mechanics.free] @ node_velocity

    def derivative(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        q, x = state.unbind(1)
        return torch.stack(self.dynamics.derivative(q, x, inputs), dim=1)

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        """Return the mean squared error of positions and of velocities times the frame, in units of
        second differences of positions; `EnergySettings.floor` says how windows are weighed.
        """
        del generator
        state = self.begin(sample.start)
        total = state.new_zeros(len(state))
        frames = sample.position.shape[1]
        for frame in range(frames):
            state = self.advance(state, sample.inputs.at(frame))
            dx = self.positions(state) - sample.position[:, frame]
            dv = self.graph.frame_s * (self.velocities(state) - sample.velocity[:, frame])
            total = total + (dx**2 + dv**2).mean((1, 2))
        error = total / (frames * self.spread**2)
        if self.floor is None:
            return error.mean()
        return (torch.log1p(error / self.floor) - torch.log1p(error)).mean()


class LGNN(EnergyModel):
    """A learned Lagrangian on a scene's constraints."""

    kind: ClassVar[type[NodeDynamics]] = Lagrangian
    # With one integrator step per frame up to 8 of 100 rollouts are lost; HGNN loses none.
    tracks: ClassVar[Mapping[str, EnergySettings]] = {
        **EnergyModel.tracks,
        "lite": msgspec.structs.replace(EnergyModel.tracks["lite"], substeps=2),
    }


class HGNN(EnergyModel):
    """A learned Hamiltonian on a scene's constraints."""

    kind: ClassVar[type[NodeDynamics]] = Hamiltonian
