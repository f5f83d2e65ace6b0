"""SGNN's hierarchy: between objects, over objects, within objects."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mbds_xsim.learn.sgnn_layer import Interaction, SubequivariantMap, end_scalars, ends, mlp
from mbds_xsim.learn.sgnn_topology import Edges, Hierarchy, pool

__all__ = ["Network"]

OBJECT_SCALE = 0.001
"""Of the sum of its particles' scalars, as SGNN feeds it to an object."""
READ = 2
"""Vectors that the first stage reads from an edge, and the third stage from an object."""
PARTICLE = 3
"""Vectors of a particle: position and velocity in its object, velocity in W."""


class Network(nn.Module):
    """Normalised motion of the next frame from normalised motion, external vectors and scalars.

    It commutes with every rotation and reflection that leaves `down` as it is, with translation
    (positions enter as differences), and with renumbering particles and objects.

    Args:
        hierarchy: particles, objects and their edges.
        externals: external vectors of a particle, such as a force on it.
        scalars: scalars of a particle.
        down: unit vector along gravity, zero without gravity, shape (3,).
        hidden: width and scalars of a node.
        layers: linear layers of each network.
        steps: message-passing steps of each stage; they share their weights.
    """

    down: Tensor

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
        self.register_buffer("down", down, persistent=False)
        self.embedding = nn.Linear(scalars, hidden)
        self.to_particle = nn.Linear(2 * hidden, hidden)
        self.between = Interaction(PARTICLE, edge_channels=1, **size, steps=steps)
        self.readout = SubequivariantMap(2 * PARTICLE + 1, [hidden, hidden], outputs=READ, **size)
        self.object_gravity = mlp(hidden, 1, hidden=hidden, layers=2)
        self.over_objects = Interaction(
            2 + externals, edge_channels=READ, edge_scalars=hidden, **size, steps=steps
        )
        self.to_inner = nn.Linear(2 * hidden, hidden)
        self.inner_gravity = mlp(hidden, 1, hidden=hidden, layers=2)
        self.within = Interaction(
            READ + PARTICLE + 1 + externals, edge_channels=1, **size, steps=steps
        )

    def forward(
        self, position: Tensor, velocity: Tensor, externals: Tensor, scalars: Tensor
    ) -> Tensor:
        """Predict the next velocity, shape (batch, particle, 3).

        Args:
            position: shape (batch, particle, 3).
            velocity: shape (batch, particle, 3).
            externals: shape (batch, particle, external, 3).
            scalars: shape (batch, particle, scalar).
        """
        of_object, members = self.hierarchy.object_of, self.hierarchy.members
        state = torch.stack([position, velocity], dim=-2)
        centre = pool(members, state)
        local = torch.cat([state - centre[:, of_object], velocity.unsqueeze(-2)], dim=-2)
        own = self.embedding(scalars)
        shared = OBJECT_SCALE * self.hierarchy.sizes * (members @ own)
        told = self.to_particle(torch.cat([shared[:, of_object], own], dim=-1))
        gravity = self.gravity(self.object_gravity, shared)
        carried, known = self.over_objects(
            torch.cat([centre[..., 1:, :], gravity, pool(members, externals)], dim=-2),
            shared,
            self.hierarchy.pairs,
            *self.contacts(position, local, told),
        )
        told = self.to_inner(torch.cat([known[:, of_object], own], dim=-1))
        gravity = self.gravity(self.inner_gravity, told)
        moved, _ = self.within(
            torch.cat([carried[:, of_object, :READ], local, gravity, externals], dim=-2),
            told,
            self.hierarchy.inner,
            apart(position, self.hierarchy.inner),
        )
        return moved[..., 0, :]

    def contacts(self, position: Tensor, local: Tensor, told: Tensor) -> tuple[Tensor, Tensor]:
        """Read the edges between objects, averaged over each pair of objects."""
        edges, pooling = self.hierarchy.inter, self.hierarchy.pooling
        if not len(pooling):  # one object, or objects that nothing joins: there is nothing to read
            shape = len(position), 0
            return position.new_zeros(*shape, READ, 3), position.new_zeros(*shape, told.shape[-1])
        along = apart(position, edges)
        vectors, scalars = self.between(local, told, edges, along)
        read, said = self.readout(ends(vectors, edges, along), *end_scalars(scalars, edges))
        return pool(pooling, read), pooling @ said

    def gravity(self, strength: nn.Module, scalars: Tensor) -> Tensor:
        """Gravity's direction times a learned strength, shape (batch, node, 1, 3)."""
        size: Tensor = strength(scalars)
        return size.unsqueeze(-1) * self.down


def apart(position: Tensor, edges: Edges) -> Tensor:
    """From an edge's sender to its receiver, shape (batch, edge, 1, 3)."""
    return (position[:, edges.receivers] - position[:, edges.senders]).unsqueeze(-2)
