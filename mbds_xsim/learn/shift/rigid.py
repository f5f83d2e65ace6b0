"""Pairs of nodes whose distance no motion changes: what a rollout must keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbds_xsim.learn.graph import Graph
from mbds_xsim.mechanism import JointKind, PlacedJoint

__all__ = ["RigidPairs"]

Array = NDArray[np.float64]

_ON = 1e-9  # of the scene's length: a node lies on a joint


@dataclass(frozen=True, eq=False)
class RigidPairs:
    """Nodes that are fixed in a common body, pair by pair."""

    first: Tensor
    """Shape (pair,)."""
    second: Tensor
    distance: Tensor
    """That the scene prescribes [m], float64."""

    @staticmethod
    def of(graph: Graph) -> RigidPairs:
        """Find them; a node on a joint is fixed in both of its bodies, an anchor in the world."""
        fixed = _fixed_in(graph)
        shared = (fixed[:, None] & fixed[None]).any(-1)
        # The distance of two anchors is not the model's doing.
        moving = ~graph.static.numpy()
        shared &= moving[:, None] | moving[None]
        first, second = (torch.from_numpy(part) for part in np.nonzero(np.triu(shared, 1)))
        apart = graph.reference[first] - graph.reference[second]
        return RigidPairs(first, second, apart.norm(dim=-1))

    def __len__(self) -> int:
        return len(self.first)

    def gap(self, nodes: Tensor) -> Tensor:
        """Largest deviation from the prescribed distances [m], shape (…), of nodes (…, node, 3)."""
        apart = (nodes[..., self.first, :] - nodes[..., self.second, :]).norm(dim=-1)
        if not len(self):
            return torch.full(nodes.shape[:-2], torch.nan).to(nodes)
        return (apart - self.distance).abs().amax(-1)


def _fixed_in(graph: Graph) -> NDArray[np.bool_]:
    """Whether each node is fixed in each body, the world (−1) last, shape (node, body + 1)."""
    fixed = np.zeros((graph.node_count, graph.body_count + 1), dtype=bool)
    fixed[np.arange(graph.node_count), graph.body.numpy()] = True
    for joint in graph.mechanism.joints:
        on = _on(graph, joint)
        for body, other in ((joint.parent, joint.child), (joint.child, joint.parent)):
            fixed[on & fixed[:, body], other] = True
    return fixed


def _on(graph: Graph, joint: PlacedJoint) -> NDArray[np.bool_]:
    """Nodes that a joint leaves where they are in both of its bodies, at the reference pose."""
    arm = _AWAY[joint.kind](graph.reference.numpy() - joint.anchor, joint.axis)
    return np.asarray(np.linalg.norm(arm, axis=-1) <= _ON * graph.length)


def _from_axis(arm: Array, axis: Array) -> Array:
    return arm - (arm @ axis)[:, None] * axis


_AWAY: dict[JointKind, Callable[[Array, Array], Array]] = {
    "fixed": lambda arm, _: np.zeros_like(arm),
    "hinge": _from_axis,
    "slider": lambda arm, _: np.full_like(arm, np.inf),
    "ball": lambda arm, _: arm,
}
