"""SGNN's network: a subequivariant map, message passing with it, and a hierarchy over objects.

Han et al., "Learning physical dynamics with subequivariant graph neural networks", NeurIPS 2022.
Vector channels enter a network only by their inner products and leave it only as combinations of
themselves, so that rotating all of them rotates the result. Gravity is one more channel: to rotate
the scene without gravity is not to rotate all channels, so the map can distinguish up from down.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from mbds_xsim.learn.layers import TensorModule, keep, mlp

LEAST_NORM = 1e-6
"""Norm below which a Gram matrix of normalised vectors counts as zero; keeps gradients finite."""
OBJECT_SCALE = 0.001
"""Factor with which SGNN feeds the sum of its particles' scalars to an object."""
READ = 2
"""Number of vectors that the first stage reads from an edge, and the third from an object."""
PARTICLE = 3
"""Number of vectors of a particle: position and velocity in its object, velocity in W."""


class Edges(nn.Module):
    """Directed edges between `node_count` nodes; there may be none."""

    senders: Tensor
    """Node that each edge comes from, shape (edge,)."""
    receivers: Tensor
    """Node that each edge goes to, shape (edge,)."""
    mean: Tensor
    """Matrix (node, edge) whose row i averages over the edges into node i, or is zero without any.
    A product with it is faster than a scatter at these sizes, runs in the same order every time,
    and is defined without edges."""

    def __init__(self, senders: Tensor, receivers: Tensor, node_count: int) -> None:
        super().__init__()
        keep(self, senders=senders, receivers=receivers, mean=averaging(receivers, node_count))


class Hierarchy(nn.Module):
    """Particles, the objects they belong to, and the edges of both.

    Edges go from senders to receivers; `inner` marks those within an object; `body` names each
    particle's object by any integer.
    """

    object_of: Tensor
    """Object of each particle, counted from 0, shape (particle,)."""
    members: Tensor
    """Matrix that averages over an object's particles, shape (object, particle)."""
    sizes: Tensor
    """Number of particles of each object, shape (object, 1)."""
    pooling: Tensor
    """Matrix that averages over a pair's edges in `inter`, shape (pair, inter edge)."""

    def __init__(self, senders: Tensor, receivers: Tensor, inner: Tensor, body: Tensor) -> None:
        super().__init__()
        names, objects = torch.unique(body, return_inverse=True)
        self.inner = Edges(senders[inner], receivers[inner], len(body))
        self.inter = Edges(senders[~inner], receivers[~inner], len(body))
        ends = torch.stack([objects[self.inter.senders], objects[self.inter.receivers]], dim=1)
        # One edge between two objects for every ordered pair with an edge in `inter`.
        pairs, pair_of = torch.unique(ends, dim=0, return_inverse=True)
        self.pairs = Edges(pairs[:, 0], pairs[:, 1], len(names))
        members = averaging(objects, len(names))
        sizes = torch.bincount(objects).to(members)[:, None]
        pooling = averaging(pair_of, len(pairs))
        keep(self, object_of=objects, members=members, sizes=sizes, pooling=pooling)


def pool(weights: Tensor, vectors: Tensor) -> Tensor:
    """Combine rows of vectors (…, row, channel, 3) with weights (group, row)."""
    combined = weights @ vectors.flatten(-2)
    return combined.reshape(*combined.shape[:-1], *vectors.shape[-2:])


def averaging(groups: Tensor, group_count: int) -> Tensor:
    """Return the matrix (group, row) that averages rows by group; empty groups give zero."""
    membership = groups == torch.arange(group_count)[:, None]
    sizes = membership.sum(dim=1, keepdim=True).clamp(min=1)
    return membership.to(torch.get_default_dtype()) / sizes


class Gathered(NamedTuple):
    """Block of scalar inputs whose rows are gathered after the first product.

    A node's row is then multiplied once, however many edges read it.
    """

    values: Tensor
    rows: Tensor


class SubequivariantMap(nn.Module):
    """Map of vectors and scalars that is equivariant to rotations of all the vectors.

    Inputs are `channels` vectors and blocks of scalars; outputs are `outputs` vectors and `hidden`
    scalars.
    """

    def __init__(
        self, channels: int, scalars: list[int], *, outputs: int, hidden: int, layers: int
    ) -> None:
        super().__init__()
        self.widths = [channels * channels, *scalars]
        self.channels, self.outputs, self.hidden = channels, outputs, hidden
        self.first = nn.Linear(sum(self.widths), hidden)
        self.rest = mlp(hidden, channels * outputs + hidden, hidden=hidden, layers=layers - 1)

    def forward(self, vectors: Tensor, *scalars: Tensor | Gathered) -> tuple[Tensor, Tensor]:
        """Map vectors (…, channel, 3) and scalars to vectors (…, output, 3), scalars (…, hidden).

        Last channels and last blocks that are left out count as zero.
        """
        count = vectors.shape[-2]
        gram, *weights = torch.split(self.first.weight, self.widths, dim=1)
        gram = gram.reshape(-1, self.channels, self.channels)[:, :count, :count].flatten(1)
        start = functional.linear(invariants(vectors), gram, self.first.bias)
        for block, weight in zip(scalars, weights[: len(scalars)], strict=True):
            if isinstance(block, Gathered):
                start += functional.linear(block.values, weight).index_select(-2, block.rows)
            else:
                start.flatten(0, -2).addmm_(block.flatten(0, -2), weight.T)
        *inner, last = self.rest
        assert isinstance(last, nn.Linear)
        deep = functional.silu(start)
        for part in inner:
            deep = part(deep)
        # Two products: the scalars to pass on are contiguous, and no weights are computed for
        # vectors that are left out.
        end = self.outputs * self.channels
        weight, bias = (self._mixing(each[:end], count) for each in (last.weight, last.bias))
        mixing = functional.linear(deep, weight, bias)
        mixing = mixing.reshape(*mixing.shape[:-1], self.outputs, count)
        return mixing @ vectors, functional.linear(deep, last.weight[end:], last.bias[end:])

    def _mixing(self, rows: Tensor, count: int) -> Tensor:
        """Keep the rows (output, vector) of the last layer that mix the first `count` vectors."""
        by_vector = rows.reshape(self.outputs, self.channels, *rows.shape[1:])
        return by_vector[:, :count].flatten(0, 1)


class Passing(nn.Module):
    """Message passing whose steps share one set of weights, without a residual.

    A node has `channels` vectors and `hidden` scalars; an edge may have some of its own.
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
        self.steps, size = steps, {"outputs": channels, "hidden": hidden, "layers": layers}
        scalars = [hidden, hidden, *([edge_scalars] if edge_scalars else [])]
        self.message = SubequivariantMap(2 * channels + edge_channels, scalars, **size)
        self.update = SubequivariantMap(2 * channels, [hidden, hidden], **size)

    def forward(
        self,
        vectors: Tensor,
        scalars: Tensor,
        edges: Edges,
        edge_vectors: Tensor,
        *edge_scalars: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Pass messages; vectors (batch, node, channel, 3), scalars (batch, node, hidden)."""
        for _ in range(self.steps):
            seen, known = vectors, [scalars]
            if len(edges.senders):  # without messages a node reads only its own state
                whole, at_ends = ends(vectors, edges, edge_vectors), end_scalars(scalars, edges)
                messages, hidden = self.message(whole, *at_ends, *edge_scalars)
                seen = torch.cat([vectors, pool(edges.mean, messages)], dim=-2)
                known.append(edges.mean @ hidden)
            vectors, scalars = self.update(seen, *known)
        return vectors, scalars


def ends(vectors: Tensor, edges: Edges, edge_vectors: Tensor) -> Tensor:
    """Return the vectors of an edge's receiver, sender and itself, (batch, edge, channel, 3)."""
    at = vectors.index_select(1, edges.receivers), vectors.index_select(1, edges.senders)
    return torch.cat([*at, edge_vectors], dim=-2)


def end_scalars(scalars: Tensor, edges: Edges) -> tuple[Gathered, Gathered]:
    """Return the scalars of an edge's receiver and sender."""
    return Gathered(scalars, edges.receivers), Gathered(scalars, edges.senders)


def apart(position: Tensor, edges: Edges) -> Tensor:
    """Return the vector from each edge's sender to its receiver, shape (batch, edge, 1, 3)."""
    return (position[:, edges.receivers] - position[:, edges.senders]).unsqueeze(-2)


def invariants(vectors: Tensor) -> Tensor:
    """Return all inner products of vectors (…, channel, 3), with unit norm, (…, channel²)."""
    products: Tensor = _Invariants.apply(vectors)  # type: ignore[no-untyped-call]
    return products


class _Invariants(torch.autograd.Function):
    """Normalised Gram matrix with a gradient written by hand, which takes half the products.

    Torch does not use that the matrix is symmetric. Differentiable once.
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


class Network(TensorModule):
    """Network for the next frame's normalised motion: between, over and within objects.

    It commutes with every rotation and reflection that leaves `down` as it is (a unit vector along
    gravity, zero without), with translation (positions enter as differences), and with renumbering
    particles and objects. Particles have external vectors, such as a force on them, and scalars.
    """

    def __init__(
        self,
        hierarchy: Hierarchy,
        *,
        externals: int,
        scalars: int,
        down: Tensor,
        hidden: int,
        layers: int,
        steps: int,
    ) -> None:
        super().__init__()
        size = {"hidden": hidden, "layers": layers}
        self.hierarchy = hierarchy
        keep(self, down=down)
        self.embedding = nn.Linear(scalars, hidden)
        self.to_particle = nn.Linear(2 * hidden, hidden)
        self.between = Passing(PARTICLE, edge_channels=1, **size, steps=steps)
        self.readout = SubequivariantMap(2 * PARTICLE + 1, [hidden, hidden], outputs=READ, **size)
        self.object_gravity = mlp(hidden, 1, hidden=hidden, layers=2)
        self.over_objects = Passing(
            2 + externals, edge_channels=READ, edge_scalars=hidden, **size, steps=steps
        )
        self.to_inner = nn.Linear(2 * hidden, hidden)
        self.inner_gravity = mlp(hidden, 1, hidden=hidden, layers=2)
        self.within = Passing(READ + PARTICLE + 1 + externals, edge_channels=1, **size, steps=steps)

    def forward(
        self, position: Tensor, velocity: Tensor, externals: Tensor, scalars: Tensor
    ) -> Tensor:
        """Predict the next velocity, shape (batch, particle, 3).

        Position and velocity have the same shape, externals (batch, particle, external, 3),
        scalars (batch, particle, scalar).
        """
        of_object, members = self.hierarchy.object_of, self.hierarchy.members
        state = torch.stack([position, velocity], dim=-2)
        centre = pool(members, state)
        local = torch.cat([state - centre[:, of_object], velocity.unsqueeze(-2)], dim=-2)
        own = self.embedding(scalars)
        shared = OBJECT_SCALE * self.hierarchy.sizes * (members @ own)
        hidden = self.to_particle(torch.cat([shared[:, of_object], own], dim=-1))
        gravity = self.gravity(self.object_gravity, shared)
        object_vectors, object_scalars = self.over_objects(
            torch.cat([centre[..., 1:, :], gravity, pool(members, externals)], dim=-2),
            shared,
            self.hierarchy.pairs,
            *self.contacts(position, local, hidden),
        )
        hidden = self.to_inner(torch.cat([object_scalars[:, of_object], own], dim=-1))
        gravity = self.gravity(self.inner_gravity, hidden)
        predicted, _ = self.within(
            torch.cat([object_vectors[:, of_object, :READ], local, gravity, externals], dim=-2),
            hidden,
            self.hierarchy.inner,
            apart(position, self.hierarchy.inner),
        )
        return predicted[..., 0, :]

    def contacts(self, position: Tensor, local: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Read the edges between objects, averaged over each pair of objects."""
        edges, pooling = self.hierarchy.inter, self.hierarchy.pooling
        if not len(pooling):  # one object, or objects that nothing joins: there is nothing to read
            shape = len(position), 0
            return position.new_zeros(*shape, READ, 3), position.new_zeros(*shape, hidden.shape[-1])
        along = apart(position, edges)
        vectors, scalars = self.between(local, hidden, edges, along)
        readings, latents = self.readout(ends(vectors, edges, along), *end_scalars(scalars, edges))
        return pool(pooling, readings), pooling @ latents

    def gravity(self, strength: nn.Module, scalars: Tensor) -> Tensor:
        """Return gravity's direction times a learned strength, shape (batch, node, 1, 3)."""
        size: Tensor = strength(scalars)
        return size.unsqueeze(-1) * self.down
