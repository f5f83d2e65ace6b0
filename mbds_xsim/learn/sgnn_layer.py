"""SGNN's subequivariant map and message passing.

Han et al., "Learning physical dynamics with subequivariant graph neural networks", NeurIPS 2022.
Vector channels enter a network only by their inner products and leave it only as combinations of
themselves, so that rotating all of them rotates the result. Gravity is one channel more: rotating
the scene without it is not rotating all of them, and the map may tell up from down.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from mbds_xsim.learn.sgnn_topology import Edges, pool

__all__ = ["Interaction", "Scalars", "SubequivariantMap", "mlp"]

LEAST_NORM = 1e-6
"""Under which a Gram matrix of normalised vectors counts as zero; keeps gradients finite."""


class Scalars(NamedTuple):
    """A block of scalar inputs; with `rows`, they are gathered after the first product.

    A node's row then costs once, however many edges read it.
    """

    values: Tensor
    rows: Tensor | None = None

    def add(self, total: Tensor, weight: Tensor) -> None:
        """Add to a total each row times the block's part of a linear layer's weight."""
        if self.rows is None:
            total.flatten(0, -2).addmm_(self.values.flatten(0, -2), weight.T)
        else:
            total += functional.linear(self.values, weight).index_select(-2, self.rows)


class SubequivariantMap(nn.Module):
    """Vectors and scalars to vectors and scalars, equivariant to rotations of all the vectors.

    Args:
        channels: how many vectors go in.
        scalars: how many scalars go in, block by block.
        outputs: how many vectors come out.
        hidden: width, and how many scalars come out.
        layers: linear layers of the network.
    """

    def __init__(
        self, channels: int, scalars: list[int], *, outputs: int, hidden: int, layers: int
    ) -> None:
        super().__init__()
        self.widths = [channels * channels, *scalars]
        self.channels, self.outputs, self.hidden = channels, outputs, hidden
        self.first = nn.Linear(sum(self.widths), hidden)
        self.rest = mlp(hidden, channels * outputs + hidden, hidden=hidden, layers=layers - 1)

    def forward(self, vectors: Tensor, *scalars: Scalars) -> tuple[Tensor, Tensor]:
        """Map vectors, shape (…, channel, 3), and scalars; give (…, output, 3), (…, hidden).

        Last channels and last blocks that are left out count as zero.
        """
        given = vectors.shape[-2]
        gram, *weights = torch.split(self.first.weight, self.widths, dim=1)
        gram = gram.reshape(-1, self.channels, self.channels)[:, :given, :given].flatten(1)
        start = functional.linear(invariants(vectors), gram, self.first.bias)
        for block, weight in zip(scalars, weights[: len(scalars)], strict=True):
            block.add(start, weight)
        *inner, last = self.rest
        assert isinstance(last, nn.Linear)
        deep = functional.silu(start)
        for part in inner:
            deep = part(deep)
        # In two products: what is passed on comes out in one piece, and what would mix a vector
        # that is left out is not computed.
        end = self.outputs * self.channels
        weight, bias = (self.mixing_rows(each[:end], given) for each in (last.weight, last.bias))
        mixing = functional.linear(deep, weight, bias)
        mixing = mixing.reshape(*mixing.shape[:-1], self.outputs, given)
        return mixing @ vectors, functional.linear(deep, last.weight[end:], last.bias[end:])

    def mixing_rows(self, rows: Tensor, given: int) -> Tensor:
        """Keep those of the last layer's mixing rows that read the first vectors, the given ones.

        Rows are in the order output, vector.
        """
        by_vector = rows.reshape(self.outputs, self.channels, *rows.shape[1:])
        return by_vector[:, :given].flatten(0, 1)


class Interaction(nn.Module):
    """Message passing whose steps share one set of weights, without a residual.

    Args:
        channels: vectors of a node.
        edge_channels: vectors of an edge.
        edge_scalars: scalars of an edge; 0 for none.
        hidden: scalars of a node, and width.
        layers: linear layers of each network.
        steps: how often the one layer is applied.
    """

    def __init__(
        self,
        channels: int,
        *,
        edge_channels: int,
        edge_scalars: int = 0,
        hidden: int,
        layers: int,
        steps: int,
    ) -> None:
        super().__init__()
        self.steps = steps
        of_edge = [edge_scalars] if edge_scalars else []
        self.message = SubequivariantMap(
            2 * channels + edge_channels,
            [hidden, hidden, *of_edge],
            outputs=channels,
            hidden=hidden,
            layers=layers,
        )
        self.update = SubequivariantMap(
            2 * channels, [hidden, hidden], outputs=channels, hidden=hidden, layers=layers
        )

    def forward(
        self,
        vectors: Tensor,
        scalars: Tensor,
        edges: Edges,
        edge_vectors: Tensor,
        edge_scalars: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Pass messages; vectors (batch, node, channel, 3), scalars (batch, node, hidden)."""
        if not len(edges.senders):  # nobody says anything: a node has only its own to go by
            for _ in range(self.steps):
                vectors, scalars = self.update(vectors, Scalars(scalars))
            return vectors, scalars
        of_edge = [] if edge_scalars is None else [Scalars(edge_scalars)]
        for _ in range(self.steps):
            sent, told = self.message(
                ends(vectors, edges, edge_vectors), *end_scalars(scalars, edges), *of_edge
            )
            heard = pool(edges.mean, sent)
            vectors, scalars = self.update(
                torch.cat([vectors, heard], dim=-2), Scalars(scalars), Scalars(edges.mean @ told)
            )
        return vectors, scalars


def ends(vectors: Tensor, edges: Edges, edge_vectors: Tensor) -> Tensor:
    """Vectors of an edge's receiver, its sender and itself, (batch, edge, channel, 3)."""
    at = vectors.index_select(1, edges.receivers), vectors.index_select(1, edges.senders)
    return torch.cat([*at, edge_vectors], dim=-2)


def end_scalars(scalars: Tensor, edges: Edges) -> tuple[Scalars, Scalars]:
    """Scalars of an edge's receiver and its sender."""
    return Scalars(scalars, edges.receivers), Scalars(scalars, edges.senders)


def invariants(vectors: Tensor) -> Tensor:
    """All inner products of the vectors (…, channel, 3), scaled to a unit norm, (…, channel²)."""
    found: Tensor = _Invariants.apply(vectors)  # type: ignore[no-untyped-call]
    return found


class _Invariants(torch.autograd.Function):
    """Its slope is symmetric, of which torch does not know: by hand it takes half the products.

    Differentiable once.
    """

    @staticmethod
    def forward(ctx: Any, vectors: Tensor) -> Tensor:
        gram = vectors @ vectors.mT
        norm = torch.linalg.matrix_norm(gram, keepdim=True)
        scaled = gram.div_(norm.clamp(min=LEAST_NORM))
        ctx.save_for_backward(vectors, scaled, norm)
        return scaled.flatten(-2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        vectors, scaled, norm = ctx.saved_tensors
        slope = slope.reshape(scaled.shape)
        along = (slope * scaled).sum((-2, -1), keepdim=True) * (norm > LEAST_NORM)
        slope = (slope - along * scaled) / norm.clamp(min=LEAST_NORM)
        return (slope + slope.mT) @ vectors


def mlp(inputs: int, outputs: int, *, hidden: int, layers: int) -> nn.Sequential:
    """Linear layers with SiLU between them."""
    widths = [inputs, *[hidden] * (layers - 1), outputs]
    parts: list[nn.Module] = [nn.Linear(widths[0], widths[1])]
    for before, after in pairwise(widths[1:]):
        parts += [nn.SiLU(), nn.Linear(before, after)]
    return nn.Sequential(*parts)
