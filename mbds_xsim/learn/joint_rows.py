"""The rows of a mechanism's joints in torch, as `mbds_xsim.scene.constraints` defines them.

A row along a direction e between two points p of its bodies has the rate e · (ṗ_child − ṗ_parent);
one of two directions that stay at right angles turns with the bodies alone.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from mbds_xsim.learn.layers import keep
from mbds_xsim.scene.constraints import layout_of
from mbds_xsim.scene.mechanism import Mechanism


class JointRows(nn.Module):
    """Residuals and Jacobian of all joints and distance links, by the twists of the bodies."""

    vector_body: Tensor
    vector: Tensor
    first: Tensor
    second: Tensor
    length: Tensor
    ends: Tensor
    """Bodies of the parents' ends of the rows, then of the children's, shape (2 · row,)."""
    pairs: Tensor
    """Ends at one and the same body, the world apart, shape (2, pair)."""
    place: Tensor
    """Where the product of such a pair is in a flat matrix (row, row), shape (pair,)."""
    axes: Tensor

    def __init__(self, mechanism: Mechanism) -> None:
        super().__init__()
        self.layout = layout = layout_of(mechanism)
        self.body_count = mechanism.body_count
        ends = torch.from_numpy(layout.row_body % (mechanism.body_count + 1)).flatten()
        moves = ends < mechanism.body_count
        first, second = torch.nonzero((ends[:, None] == ends) & moves[:, None], as_tuple=True)
        keep(
            self,
            vector_body=layout.vector_body,
            vector=layout.vector,
            first=layout.span_body[0],
            second=layout.span_body[1],
            length=layout.length,
            ends=ends,
            pairs=torch.stack([first, second]),
            place=layout.row_count * (first % layout.row_count) + second % layout.row_count,
            axes=torch.eye(3).double().repeat(layout.points.stop, 1),
        )

    def __len__(self) -> int:
        return self.layout.row_count

    def vectors(self, turn: Tensor) -> Tensor:
        """Turn all that is fixed in bodies with them, shape (batch, vector, 3).

        By the rotation matrices of bodies and of the world behind them.
        """
        return (turn[:, self.vector_body] @ self.vector[..., None])[..., 0]

    def residual(self, x: Tensor, turn: Tensor) -> Tensor:
        """How far rows are from 0 [m or rad], shape (batch, row).

        Of centres of mass [m] and rotation matrices, the world the last of the bodies.
        """
        return self._spans(x, turn)[2]

    def halves(self, x: Tensor, turn: Tensor) -> Tensor:
        """Derivatives of the rows by the twists of the bodies at their ends (`ends`).

        Shape (batch, 2 · row, 6): by the parents' first, then by the children's.
        """
        carried, span, _ = self._spans(x, turn)
        layout, count = self.layout, len(self.first)
        points, along, links = layout.points, layout.along, layout.distances
        begin, end = carried[:, :count], carried[:, count : 2 * count]
        directions = [
            self.axes.expand(len(x), -1, -1),
            carried[:, layout.along_normal],
            functional.normalize(span[:, links], dim=-1),
        ]
        parents = [_thrice(begin[:, points]), (begin + span)[:, along], begin[:, links]]
        children = [_thrice(end[:, points]), end[:, along], end[:, links]]
        lever = torch.linalg.cross(carried[:, layout.lever], carried[:, layout.normal])
        move = torch.cat([*directions[:2], torch.zeros_like(lever), directions[2]], dim=1)
        halves = []
        for arms, sign in ((parents, -1.0), (children, 1.0)):
            swing = [torch.linalg.cross(*pair) for pair in zip(arms, directions, strict=True)]
            spin = torch.cat([*swing[:2], lever, swing[2]], dim=1)
            halves.append(sign * torch.cat([move, spin], dim=-1))
        return torch.cat(halves, dim=1)

    def _spans(self, x: Tensor, turn: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What is fixed in bodies, spans from parents to children, and residuals."""
        layout, carried, count = self.layout, self.vectors(turn), len(self.first)
        begin, end = carried[:, :count], carried[:, count : 2 * count]
        span = x[:, self.second] + end - x[:, self.first] - begin
        residual = [
            span[:, layout.points].flatten(1),
            (carried[:, layout.along_normal] * span[:, layout.along]).sum(-1),
            (carried[:, layout.lever] * carried[:, layout.normal]).sum(-1),
            span[:, layout.distances].norm(dim=-1) - self.length,
        ]
        return carried, span, torch.cat(residual, dim=1)


def _thrice(arms: Tensor) -> Tensor:
    return arms.repeat_interleave(3, dim=1)
