"""LGNN: accelerations from a learned Lagrangian L = T(q̇) − V(q) (Bhattoo et al., NeurIPS 2022).

M q̈ = −∂V/∂q + F + drag − Aᵀ λ with A q̈ = −Ȧ q̇, A from the scene's joints. T depends on velocities
alone, so that Coriolis terms vanish and M = ∂²T/∂q̇² has a closed form.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import msgspec
import torch
from torch import Tensor, nn

from mbds_xsim.learn.energy import Energy, mass_matrix, momentum, potential_force
from mbds_xsim.learn.energy_model import EnergyModel, EnergySettings
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.mechanics import constrained
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import Inputs

__all__ = ["LGNN", "Lagrangian"]


class Lagrangian(nn.Module):
    """Lagrangian dynamics of an energy."""

    def __init__(self, energy: Energy, drag: nn.Module | None = None) -> None:
        super().__init__()
        self.energy, self.drag = energy, drag
        self.mechanics = energy.mechanics

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor, torque: Tensor) -> Tensor:
        """Accelerations of the free nodes [m/s²], shape (batch, node, 3).

        Args:
            q: Free nodes [m], shape (batch, node, 3).
            v: Their velocities [m/s].
            force: On centres of mass [N], shape (batch, body, 3).
            torque: About the hinges [N·m], shape (batch, hinge).
        """
        load = potential_force(self.energy, q) + self.mechanics.applied(q, v, force, torque)
        if self.drag is not None:
            load = load + self.drag(v)
        mass = mass_matrix(self.mechanics, self.energy.kinetic(v), v)
        jacobian = self.mechanics.jacobian(q).dense()
        bias, redundant = self.mechanics.bias(v), self.mechanics.redundant
        solved = constrained(mass, load.flatten(1), jacobian, bias, redundant)
        return solved.view_as(q)

    def total_energy(self, q: Tensor, v: Tensor) -> Tensor:
        """q̇ · ∂L/∂q̇ − L [J], shape (batch,)."""
        kinetic = self.energy.kinetic(v)
        action = (v * momentum(self.mechanics, kinetic, v)).sum((-1, -2))
        return action - kinetic.total + self.energy.potential(q)


class LGNN(EnergyModel):
    """A learned Lagrangian on a scene's constraints."""

    # With one step of the integrator a frame up to 8 of 100 rollouts are lost, HGNN's are not.
    tracks: ClassVar[Mapping[str, EnergySettings]] = {
        **EnergyModel.tracks,
        "lite": msgspec.structs.replace(EnergyModel.tracks["lite"], substeps=2),
    }

    def __init__(self, graph: Graph, statistics: Statistics, settings: EnergySettings) -> None:
        super().__init__(graph, statistics, settings)
        self.dynamics = Lagrangian(self.energy, self.drag)

    def derivative(self, state: Tensor, inputs: Inputs) -> Tensor:
        """See `FlowModel`."""
        q, v = state.unbind(1)
        force, torque = inputs.force.to(q), inputs.torque.to(q)
        return torch.stack([v, self.dynamics.acceleration(q, v, force, torque)], dim=1)
