"""HGNN: time derivatives from a learned Hamiltonian H = T(p) + V(q) (Bishnoi et al., 2023).

The canonical equations are projected on the constraints φ = 0 and A u = 0 with Dirac's bracket:
ż = J (∇H + Φᵀ Λ), Φ the Jacobian of both by (q, p). Its block structure leaves two solves with
A M⁻¹ Aᵀ. T is a function of u = M⁻¹ p with the scene's known mass matrix, so of |p_i|² / m_i² where
masses are uncoupled: in u the rods' coupling keeps to neighbours, in p it does not.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mbds_xsim.learn.energy import Energy, momentum, potential_force
from mbds_xsim.learn.energy_model import EnergyModel, EnergySettings
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import Inputs

__all__ = ["HGNN", "Hamiltonian"]


class Hamiltonian(nn.Module):
    """Hamiltonian dynamics of an energy."""

    def __init__(self, energy: Energy, drag: nn.Module | None = None) -> None:
        super().__init__()
        self.energy, self.drag = energy, drag
        self.mechanics = energy.mechanics

    def momentum(self, v: Tensor) -> Tensor:
        """Momenta p = M v [kg·m/s] of velocities (batch, node, 3)."""
        return self.mechanics.mass @ v

    def derivative(
        self, q: Tensor, p: Tensor, force: Tensor, torque: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Rates of q [m/s] and p [N], shapes (batch, node, 3).

        Args:
            q: Free nodes [m], shape (batch, node, 3).
            p: Their momenta [kg·m/s].
            force: On centres of mass [N], shape (batch, body, 3).
            torque: About the hinges [N·m], shape (batch, hinge).
        """
        mechanics = self.mechanics
        u = mechanics.mass_inverse @ p
        jacobian, rate = mechanics.jacobian(q), mechanics.jacobian_rate(u)
        solver = mechanics.factored(jacobian)
        slope = momentum(mechanics, self.energy.kinetic(u), u)
        q_rate = mechanics.mass_inverse @ slope
        second = -solver(jacobian.along(q_rate))
        q_rate = q_rate + mechanics.mass_inverse @ jacobian.back(second)
        load = potential_force(self.energy, q) + mechanics.applied(q, q_rate, force, torque)
        if self.drag is not None:
            load = load + self.drag(q_rate)
        p_rate = load - rate.back(second)
        first = solver(rate.along(q_rate) + jacobian.along(mechanics.mass_inverse @ p_rate))
        return q_rate, p_rate - jacobian.back(first)

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor, torque: Tensor) -> Tensor:
        """M⁻¹ ṗ at p = M v [m/s²]: q̈ where H is the true one; shape (batch, node, 3)."""
        _, p_rate = self.derivative(q, self.momentum(v), force, torque)
        return self.mechanics.mass_inverse @ p_rate

    def total_energy(self, q: Tensor, p: Tensor) -> Tensor:
        """H [J], shape (batch,)."""
        return self.energy.kinetic(self.mechanics.mass_inverse @ p).total + self.energy.potential(q)


class HGNN(EnergyModel):
    """A learned Hamiltonian on a scene's constraints."""

    def __init__(self, graph: Graph, statistics: Statistics, settings: EnergySettings) -> None:
        super().__init__(graph, statistics, settings)
        self.dynamics = Hamiltonian(self.energy, self.drag)

    def conjugate(self, v: Tensor) -> Tensor:
        """See `EnergyModel`."""
        return self.dynamics.momentum(v)

    def moving(self, state: Tensor) -> Tensor:
        """Give u = M⁻¹ p; the learned ∂H/∂p tends to it as training goes on."""
        return self.mechanics.mass_inverse @ state[:, 1]

    def derivative(self, state: Tensor, inputs: Inputs) -> Tensor:
        """See `FlowModel`."""
        q, p = state.unbind(1)
        force, torque = inputs.force.to(q), inputs.torque.to(q)
        return torch.stack(self.dynamics.derivative(q, p, force, torque), dim=1)
