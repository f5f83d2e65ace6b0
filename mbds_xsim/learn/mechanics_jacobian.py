"""Jacobians of constraints as sums of outer products, not as dense matrices.

The gradient of (U x) · (W x) by nodes is U ⊗ (W x) + W ⊗ (U x). Each of these *terms* is constant
weights of the nodes times a direction that the state sets, so that A M⁻¹ Aᵀ is a constant matrix
times, element by element, products of directions: work with rows², not with rows² · nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mbds_xsim.learn.mechanics_rows import PointRows

__all__ = ["Jacobian", "Terms"]

Array = NDArray[np.float64]


class Terms(nn.Module):
    """What is constant of the terms: the first of each row, then the second of some."""

    weight: Tensor
    """Of free nodes, shape (term, node)."""
    moving: Tensor
    """Directions are these weights of the free nodes, shape (term, node),"""
    still: Tensor
    """and this of the fixed ones [m], shape (term, 3)."""
    coupling: Tensor
    """Weights times M⁻¹ times weights [1/kg], shape (term, term)."""
    again: Tensor
    """Rows of the second terms."""

    def __init__(self, rows: PointRows, fixed: Array, mass_inverse: Array) -> None:
        super().__init__()
        free = len(mass_inverse)
        moves = rows.first[:, :free].any(axis=1, keepdims=True)
        first, second = np.where(moves, [rows.first, rows.second], [rows.second, rows.first])
        # Both halves of a squared length are alike; those of a vector and the world's are not two.
        alike = (first == second).all(axis=1)
        again = (~alike & second[:, :free].any(axis=1)).nonzero()[0]
        weight = np.concatenate([np.where(alike, 2.0, 1.0)[:, None] * first, second[again]])
        weight = weight[:, :free]
        other = np.concatenate([second, first[again]])
        self.row_count = len(rows.goal)
        for name, values in (
            ("weight", weight),
            ("moving", other[:, :free].copy()),
            ("still", other[:, free:] @ fixed),
            ("coupling", weight @ mass_inverse @ weight.T),
            ("again", again),
        ):
            self.register_buffer(name, torch.as_tensor(values), persistent=False)

    def at(self, q: Tensor) -> Jacobian:
        """Give A at free nodes (batch, node, 3)."""
        return Jacobian(self, self.moving @ q + self.still)

    def rate(self, v: Tensor) -> Jacobian:
        """Give Ȧ at their velocities."""
        return Jacobian(self, self.moving @ v)

    def summed(self, values: Tensor, dim: int) -> Tensor:
        """Sum terms to rows."""
        if not len(self.again):
            return values
        first = values.narrow(dim, 0, self.row_count)
        second = values.narrow(dim, self.row_count, len(self.again))
        return first.index_add(dim, self.again, second)

    def spread(self, values: Tensor) -> Tensor:
        """Give each term its row's value, (batch, row) to (batch, term)."""
        return torch.cat([values, values[:, self.again]], 1) if len(self.again) else values


@dataclass(frozen=True, eq=False)
class Jacobian:
    """A matrix (row, 3 · node) for each of a batch."""

    terms: Terms
    direction: Tensor
    """Shape (batch, term, 3)."""

    def along(self, v: Tensor) -> Tensor:
        """A v, shape (batch, row), of v (batch, node, 3)."""
        return self.terms.summed(((self.terms.weight @ v) * self.direction).sum(-1), 1)

    def back(self, multiplier: Tensor) -> Tensor:
        """Aᵀ λ, shape (batch, node, 3), of λ (batch, row)."""
        pull = self.terms.spread(multiplier)[..., None] * self.direction
        return self.terms.weight.T @ pull

    def over_mass(self) -> Tensor:
        """A M⁻¹ Aᵀ, shape (batch, row, row)."""
        both = self.terms.coupling * (self.direction @ self.direction.mT)
        return self.terms.summed(self.terms.summed(both, 1), 2)

    def dense(self) -> Tensor:
        """A itself, shape (batch, row, 3 · node)."""
        outer = self.terms.weight[:, :, None] * self.direction[:, :, None]
        return self.terms.summed(outer.flatten(2), 1)
