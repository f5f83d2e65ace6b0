"""Energies of HGNN and LGNN: of speeds, and of positions; the true one and the learned one.

Kinetic energy is a sum over nodes of f(|v_i|²) and over rods (a body's tip and centre of mass) of
f(|v_i − v_j|²). The rods carry the rotation: a particle welded to its rod couples neighbours.
First and second derivatives of f come with it in closed form, and with these the mass matrix
∂²T/∂v².
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from mbds_xsim.learn.mechanics import Mechanics

__all__ = [
    "Energy",
    "Kinetic",
    "TrueEnergy",
    "mass_matrix",
    "momentum",
    "potential_force",
    "squares",
    "velocities",
]


@dataclass(frozen=True)
class Kinetic:
    """Kinetic energies of free nodes and of rods, as functions of squared speeds."""

    value: Tensor
    """f [J], shape (batch, node + rod)."""
    first: Tensor
    """f′ [kg], of the same shape."""
    second: Tensor
    """f″ [kg·s²/m²], of the same shape."""

    @property
    def total(self) -> Tensor:
        """T [J], shape (batch,)."""
        return self.value.sum(-1)


class Energy(Protocol):
    """What a Lagrangian or Hamiltonian is made of."""

    mechanics: Mechanics

    def kinetic(self, v: Tensor) -> Kinetic:
        """Kinetic energy at velocities of the free nodes (batch, node, 3)."""

    def potential(self, q: Tensor) -> Tensor:
        """Potential energy [J], shape (batch,), at free nodes (batch, node, 3)."""


class TrueEnergy(nn.Module):
    """The scene's own energy."""

    def __init__(self, mechanics: Mechanics) -> None:
        super().__init__()
        self.mechanics = mechanics

    def kinetic(self, v: Tensor) -> Kinetic:
        """See `Energy`."""
        square, half = squares(velocities(self.mechanics, v)), 0.5 * self.mechanics.moved_mass
        return Kinetic(half * square, half.expand_as(square), torch.zeros_like(square))

    def potential(self, q: Tensor) -> Tensor:
        """See `Energy`."""
        mass = self.mechanics.moved_mass[: self.mechanics.free, None]
        weight = -(mass * q * self.mechanics.gravity).sum((-1, -2))
        span = torch.linalg.vector_norm(self.mechanics.spring @ self.mechanics.all_nodes(q), dim=-1)
        stiffness, rest = self.mechanics.spring_law[:, 0], self.mechanics.spring_law[:, 1]
        return weight + 0.5 * (stiffness * (span - rest) ** 2).sum(-1)


def squares(v: Tensor) -> Tensor:
    """Squared lengths of vectors (…, 3)."""
    return (v * v).sum(-1)


def velocities(mechanics: Mechanics, v: Tensor) -> Tensor:
    """Of free nodes, and of tips relative to centres of mass, shape (batch, node + rod, 3)."""
    return mechanics.speed_map @ v


def momentum(mechanics: Mechanics, kinetic: Kinetic, v: Tensor) -> Tensor:
    """∂T/∂v, shape (batch, node, 3)."""
    return mechanics.speed_map.T @ (2.0 * kinetic.first[..., None] * velocities(mechanics, v))


def mass_matrix(mechanics: Mechanics, kinetic: Kinetic, v: Tensor) -> Tensor:
    """∂²T/∂v² in closed form, shape (batch, 3 · node, 3 · node): blocks 2 f′ 1 + 4 f″ v vᵀ."""
    each, size = velocities(mechanics, v), 3 * v.shape[1]
    outer = 4.0 * kinetic.second[..., None, None] * each[..., :, None] * each[..., None, :]
    eye = torch.eye(3).to(v)
    own = 2.0 * kinetic.first[..., None, None] * eye + outer
    blocks = (mechanics.coupling @ own.flatten(-2)).flatten(1)
    flat = v.new_zeros(len(v), size * size).index_copy_(1, mechanics.block, blocks)
    return flat.view(len(v), size, size)


def potential_force(energy: Energy, q: Tensor) -> Tensor:
    """−∂V/∂q [N], shape (batch, node, 3); differentiable where gradients are on."""
    outer = torch.is_grad_enabled()
    with torch.enable_grad():
        place = q if q.requires_grad else q.detach().requires_grad_()
        (slope,) = torch.autograd.grad(energy.potential(place).sum(), place, create_graph=outer)
    return -slope
