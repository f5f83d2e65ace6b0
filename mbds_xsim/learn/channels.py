"""Known inputs as vectors at the nodes, from the positions of the particles alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mbds_xsim.errors import Unsupported
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.window import Inputs
from mbds_xsim.mechanism import WORLD_INDEX, PlacedJoint
from mbds_xsim.sampling_terms import HingeTorque

__all__ = ["CHANNELS", "Channels"]

Array = NDArray[np.float64]

CHANNELS = ("force", "torque")
"""Of each node: its share of the force on its body by mass [N]; the torque on its body [N·m]."""

_RANK = 1e-6  # of the largest extent of a body's particles


class Channels(nn.Module):
    """Turns inputs into vectors at the nodes.

    A rollout knows particles only, so the axis of a driven hinge must follow from them. In a body
    that they span it is a fixed combination of their positions; in a plane one, part of it is
    along the cross product of two such combinations. Both turn with the body, exactly.
    """

    along: Tensor
    first: Tensor
    second: Tensor
    fixed: Tensor
    acts: Tensor
    share: Tensor
    owner: Tensor

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        hinges = graph.mechanism.hinges
        driven = set(_driven(graph))
        rows = [
            _weights(graph, hinge) if hinge.name in driven else _nothing(graph) for hinge in hinges
        ]
        count = graph.particle_count
        for k, name in enumerate(("along", "first", "second")):
            weights = np.array([row[k] for row in rows]).reshape(-1, count)
            self.register_buffer(name, torch.from_numpy(weights).float(), persistent=False)
        fixed = np.array([row[3] for row in rows]).reshape(-1, 3)
        self.register_buffer("fixed", torch.from_numpy(fixed).float(), persistent=False)
        self.register_buffer("acts", _acts(graph).float(), persistent=False)
        self.register_buffer("share", _share(graph).float(), persistent=False)
        self.register_buffer("owner", graph.body.clamp(min=0), persistent=False)

    def forward(self, particles: Tensor, inputs: Inputs) -> Tensor:
        """Give the vectors at the nodes, shape (…, node, channel, 3).

        Args:
            particles: Positions in W [m], shape (…, particle, 3).
            inputs: Of one frame, shapes (…, body, 3) and (…, hinge).
        """
        force = inputs.force[..., self.owner, :] * self.share[:, None]
        torque = self.acts @ (inputs.torque[..., None] * self.axes(particles))
        return torch.stack([force, torque], dim=-2)

    def axes(self, particles: Tensor) -> Tensor:
        """Unit vectors of the driven hinges in W, 0 of others, shape (…, hinge, 3)."""
        normal = torch.linalg.cross(self.first @ particles, self.second @ particles)
        return nn.functional.normalize(self.along @ particles + normal + self.fixed, dim=-1)


def _driven(graph: Graph) -> Iterator[str]:
    """Names of the hinges that the scene drives."""
    for load in graph.scene.torques:
        yield load.joint
    for term in graph.scene.sampling:
        if isinstance(term, HingeTorque):
            yield from term.joints


def _acts(graph: Graph) -> Tensor:
    """1 where a hinge's child has a node, −1 where its parent has, shape (node, hinge)."""
    hinges = graph.mechanism.hinges
    owner = graph.body.cpu()[:, None]
    child = torch.tensor([hinge.child for hinge in hinges], dtype=torch.int64)
    parent = torch.tensor([hinge.parent for hinge in hinges], dtype=torch.int64)
    sign = (owner == child).double() - (owner == parent).double()
    return sign * (owner >= 0)


def _share(graph: Graph) -> Tensor:
    """Of its body's mass in a node, 0 in anchors, shape (node,)."""
    owner, mass = graph.body.cpu(), graph.mass.cpu()
    whole = torch.from_numpy(graph.mechanism.mass)
    return torch.where(owner >= 0, mass / whole[owner.clamp(min=0)], 0.0)


Row = tuple[Array, Array, Array, Array]


def _nothing(graph: Graph) -> Row:
    none = np.zeros(graph.particle_count)
    return none, none, none, np.zeros(3)


def _weights(graph: Graph, hinge: PlacedJoint) -> Row:
    """How a hinge's axis follows from the particles: `along`, `first`, `second` and `fixed`."""
    none = np.zeros(graph.particle_count)
    if hinge.parent == WORLD_INDEX or graph.scene.dimension < 3:
        return none, none, none, hinge.axis
    for body in (hinge.parent, hinge.child):
        found = _of_body(graph, body, hinge.axis)
        if found is not None:
            return *found, np.zeros(3)
    msg = (
        f"joint {hinge.name!r} is driven, but its axis cannot be seen from the particles of "
        "either body, which are on one line; give one of them a particle beside it"
    )
    raise Unsupported(msg)


def _of_body(graph: Graph, body: int, axis: Array) -> tuple[Array, Array, Array] | None:
    """Weights of a body's particles, or None where they do not tell the axis."""
    mine = np.flatnonzero(graph.body.cpu().numpy() == body)
    points = graph.reference.cpu().numpy()[mine]
    arms = points - points.mean(axis=0)
    extents, directions = np.linalg.svd(arms, full_matrices=False)[1:]
    rank = int(np.sum(extents > _RANK * graph.length))
    spanned = directions[:rank]
    inside = spanned.T @ (spanned @ axis)
    outside = axis - inside
    if rank < 2 and np.linalg.norm(outside) > _RANK:
        return None
    back = np.linalg.pinv(arms.T, rcond=_RANK)
    along, first, second = (np.zeros(graph.particle_count) for _ in range(3))
    along[mine] = back @ inside
    if rank == 2:
        normal = np.cross(spanned[0], spanned[1])
        first[mine], second[mine] = back @ spanned[0] * (outside @ normal), back @ spanned[1]
    return along, first, second
