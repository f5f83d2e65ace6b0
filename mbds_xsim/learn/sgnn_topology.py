"""The fixed graphs of SGNN's hierarchy, as index and averaging tensors that move with the model."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["Edges", "Hierarchy", "pool"]


class Edges(nn.Module):
    """Directed edges between `node_count` nodes; there may be none.

    Attributes:
        senders: node each edge comes from, shape (edge,).
        receivers: node each edge goes to, shape (edge,).
        mean: row i averages over the edges into node i, and is zero where there are none, shape
            (node, edge). A product with it is faster than a scatter at these sizes, runs in the
            same order every time, and is defined without edges.
    """

    senders: Tensor
    receivers: Tensor
    mean: Tensor

    def __init__(self, senders: Tensor, receivers: Tensor, node_count: int) -> None:
        super().__init__()
        fixed(self, "senders", senders)
        fixed(self, "receivers", receivers)
        fixed(self, "mean", averaging(receivers, node_count))


class Hierarchy(nn.Module):
    """Particles, the objects they belong to, and the edges of both.

    Args:
        senders: particle each edge comes from, shape (edge,).
        receivers: particle each edge goes to, shape (edge,).
        inner: whether an edge joins two particles of one object, shape (edge,).
        body: an object's name for each particle, any integers, shape (particle,).

    Attributes:
        inner: edges within an object.
        inter: edges between two objects.
        pairs: an edge between two objects for every ordered pair with an edge in `inter`.
        object_of: the object of each particle, counted from 0, shape (particle,).
        members: averages over an object's particles, shape (object, particle).
        sizes: particles of each object, shape (object, 1).
        pooling: averages over a pair's edges in `inter`, shape (pair, inter edge).
    """

    object_of: Tensor
    members: Tensor
    sizes: Tensor
    pooling: Tensor

    def __init__(self, senders: Tensor, receivers: Tensor, inner: Tensor, body: Tensor) -> None:
        super().__init__()
        names, objects = torch.unique(body, return_inverse=True)
        self.inner = Edges(senders[inner], receivers[inner], len(body))
        self.inter = Edges(senders[~inner], receivers[~inner], len(body))
        ends = torch.stack([objects[self.inter.senders], objects[self.inter.receivers]], dim=1)
        pairs, pair_of = torch.unique(ends, dim=0, return_inverse=True)
        self.pairs = Edges(pairs[:, 0], pairs[:, 1], len(names))
        fixed(self, "object_of", objects)
        fixed(self, "members", averaging(objects, len(names)))
        fixed(self, "sizes", torch.bincount(objects).to(self.members)[:, None])
        fixed(self, "pooling", averaging(pair_of, len(pairs)))


def pool(weights: Tensor, vectors: Tensor) -> Tensor:
    """Combine rows of vectors (…, row, channel, 3) with weights (group, row)."""
    combined = weights @ vectors.flatten(-2)
    return combined.reshape(*combined.shape[:-1], *vectors.shape[-2:])


def averaging(groups: Tensor, group_count: int) -> Tensor:
    """Matrix that averages rows by group, shape (group, row); an empty group averages to zero."""
    belongs = groups == torch.arange(group_count)[:, None]
    sizes = belongs.sum(dim=1, keepdim=True).clamp(min=1)
    return belongs.to(torch.get_default_dtype()) / sizes


def fixed(module: nn.Module, name: str, value: Tensor) -> None:
    """Keep a tensor that follows the module's device but is no part of what it learned."""
    module.register_buffer(name, value, persistent=False)
