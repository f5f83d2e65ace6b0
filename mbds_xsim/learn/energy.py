"""Energies of HGNN and LGNN: of speeds, and of positions; the true one and the learned one.

Kinetic energy is a sum over nodes of f(|v_i|²) and over rods (a body's tip and centre of mass) of
g(|v_i − v_j|²). The rods carry the rotation: a particle welded to its rod couples neighbours.
First and second derivatives of f and g come with them in closed form, and with these the mass
matrix ∂²T/∂v².
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
    "rod_velocity",
    "squares",
]


@dataclass(frozen=True)
class Kinetic:
    """Kinetic energies and their derivatives by squared speeds."""

    node: tuple[Tensor, Tensor, Tensor]
    """f, f′, f″ of each free node, shapes (batch, node)."""
    rod: tuple[Tensor, Tensor, Tensor]
    """g, g′, g″ of each rod, shapes (batch, rod)."""

    @property
    def total(self) -> Tensor:
        """T [J], shape (batch,)."""
        return self.node[0].sum(-1) + self.rod[0].sum(-1)


class Energy(Protocol):
    """What a Lagrangian or Hamiltonian is made of."""

    mechanics: Mechanics

    def kinetic(self, v: Tensor) -> Kinetic:
        """Kinetic energy at velocities of the free nodes (batch, node, 3)."""

    def potential(self, q: Tensor) -> Tensor:
        """Potential energy [J], shape (batch,), at free nodes (batch, node, 3)."""


class TrueEnergy(nn.Module):
    """The scene's own energy."""

    mass: Tensor
    rod_mass: Tensor

    def __init__(self, mechanics: Mechanics) -> None:
        super().__init__()
        self.mechanics = mechanics
        points = mechanics.points
        self.register_buffer("mass", torch.as_tensor(points.mass[: points.free]), persistent=False)
        self.register_buffer("rod_mass", torch.as_tensor(points.rod_mass), persistent=False)

    def kinetic(self, v: Tensor) -> Kinetic:
        """See `Energy`."""
        return Kinetic(
            _linear(0.5 * self.mass, squares(v)),
            _linear(0.5 * self.rod_mass, squares(rod_velocity(self.mechanics, v))),
        )

    def potential(self, q: Tensor) -> Tensor:
        """See `Energy`."""
        weight = -(self.mass[:, None] * q * self.mechanics.gravity).sum((-1, -2))
        span = torch.linalg.vector_norm(self.mechanics.spring @ self.mechanics.all_nodes(q), dim=-1)
        stiffness, rest = self.mechanics.spring_law[:, 0], self.mechanics.spring_law[:, 1]
        return weight + 0.5 * (stiffness * (span - rest) ** 2).sum(-1)


def squares(v: Tensor) -> Tensor:
    """Squared lengths of vectors (…, 3)."""
    return (v * v).sum(-1)


def rod_velocity(mechanics: Mechanics, v: Tensor) -> Tensor:
    """Velocities of tips relative to their bodies' centres of mass, shape (batch, rod, 3)."""
    return mechanics.rod_map @ v


def momentum(mechanics: Mechanics, kinetic: Kinetic, v: Tensor) -> Tensor:
    """∂T/∂v, shape (batch, node, 3)."""
    along = 2.0 * kinetic.rod[1][..., None] * rod_velocity(mechanics, v)
    return 2.0 * kinetic.node[1][..., None] * v + mechanics.rod_map.T @ along


def mass_matrix(mechanics: Mechanics, kinetic: Kinetic, v: Tensor) -> Tensor:
    """∂²T/∂v² in closed form, shape (batch, 3 · node, 3 · node)."""
    blocks = v.new_zeros(len(v), v.shape[1] ** 2, 9)
    blocks = blocks.index_add(1, mechanics.diagonal, _block(kinetic.node, v))
    rods = _block(kinetic.rod, rod_velocity(mechanics, v))
    rods = mechanics.rod_sign[:, None] * rods[:, mechanics.rod_index]
    blocks = blocks.index_add(1, mechanics.rod_place, rods)
    count = v.shape[1]
    square = blocks.view(len(v), count, count, 3, 3).transpose(2, 3)
    return square.reshape(len(v), 3 * count, 3 * count)


def _block(slopes: tuple[Tensor, Tensor, Tensor], v: Tensor) -> Tensor:
    """2 f′ 1 + 4 f″ v vᵀ, shape (batch, k, 9)."""
    outer = v[..., :, None] * v[..., None, :]
    eye = torch.eye(3).to(v)
    block = 2.0 * slopes[1][..., None, None] * eye + 4.0 * slopes[2][..., None, None] * outer
    return block.flatten(-2)


def _linear(slope: Tensor, square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return slope * square, slope.expand_as(square), torch.zeros_like(square)


def potential_force(energy: Energy, q: Tensor) -> Tensor:
    """−∂V/∂q [N], shape (batch, node, 3); differentiable where gradients are on."""
    outer = torch.is_grad_enabled()
    with torch.enable_grad():
        place = q if q.requires_grad else q.detach().requires_grad_()
        (slope,) = torch.autograd.grad(energy.potential(place).sum(), place, create_graph=outer)
    return -slope
