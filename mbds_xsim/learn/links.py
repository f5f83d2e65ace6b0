"""Tree of a mechanism in torch: motions of each body on its parent that the joint allows.

A body moves with the body that carries it, and in addition as its own joint allows: in any way if
it is free, about any axis on a ball joint, about one axis on a hinge, along one on a slider.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mbds_xsim.learn import turning
from mbds_xsim.learn.layers import TensorModule, keep
from mbds_xsim.learn.rigid import Q, X
from mbds_xsim.scene.mechanism import Link, Mechanism


class Links(TensorModule):
    """Tree of bodies that carry each other, and the motion of each on its joint."""

    carried: Tensor
    """Matrix whose row i is 1 at body i and at all bodies that carry it, shape (body, body)."""
    parent: Tensor
    """Body that carries each body; the world follows the bodies, shape (body,)."""
    arm: Tensor
    """Vector from the centre of mass to the joint in the native frame [m]; 0 for free bodies."""

    def __init__(self, mechanism: Mechanism) -> None:
        super().__init__()
        count = mechanism.body_count
        links = sorted(mechanism.links, key=lambda link: link.body)
        carried = torch.eye(count).double()
        for link in mechanism.links:  # parents come before children
            if link.parent >= 0:
                carried[link.body] += carried[link.parent]
        # Others than free bodies and ball joints shift or turn at most along an axis.
        free = torch.tensor([[link.joint is None] for link in links])
        balls = torch.tensor([[bool(link.joint and link.joint.kind == "ball")] for link in links])
        keep(
            self,
            carried=carried,
            parent=torch.tensor([link.parent % (count + 1) for link in links]),
            arm=_table(links, "in_child"),
            shift_axis=_table(links, "axis", "slider"),
            turn_axis=_table(links, "axis", "hinge"),
            shifts=free.double(),
            turns=(free | balls).double(),
        )

    def forward(self, state: Tensor, shift: Tensor, turn: Tensor) -> Tensor:
        """Return the twists (batch, body, 6) of bodies with these motions on their joints.

        States are (batch, body, 13); shifts and turns, relative to the parent's, (batch, body, 3).
        """
        shift = self.shifts * shift + _along(self._turned(self.shift_axis, state), shift)
        turn = self.turns * turn + _along(self._turned(self.turn_axis, state), turn)
        pivot = state[..., X] + self._turned(self.arm, state)
        spin = self.carried @ turn
        lever = self.carried @ (shift - torch.linalg.cross(turn, pivot))
        return torch.cat([lever + torch.linalg.cross(spin, state[..., X]), spin], dim=-1)

    def beside(self, values: Tensor) -> Tensor:
        """Subtract the parent's vector from each body's, (batch, body, 3); the world's is 0."""
        return values - nn.functional.pad(values, (0, 0, 0, 1))[:, self.parent]

    def _turned(self, vectors: Tensor, state: Tensor) -> Tensor:
        return turning.rotate(state[..., Q], vectors)


def _table(links: list[Link], name: str, kind: str = "") -> Tensor:
    """Return a vector of each link's joint; 0 for joints of another kind and free bodies."""
    rows = [
        list(getattr(link.joint, name))
        if link.joint and kind in ("", link.joint.kind)
        else [0.0] * 3
        for link in links
    ]
    return torch.tensor(rows, dtype=torch.float64)


def _along(axis: Tensor, vectors: Tensor) -> Tensor:
    return (axis * vectors).sum(-1, keepdim=True) * axis
