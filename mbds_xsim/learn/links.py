"""The tree of a mechanism in torch: motions that its joints allow, of each body on the one below.

A body moves with the body that carries it, and beside that as its own joint lets it: any way where
it is free, about any axis on a ball joint, about one on a hinge, along one on a slider.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mbds_xsim.learn import turning
from mbds_xsim.learn.layers import keep
from mbds_xsim.learn.rigid import Q, X
from mbds_xsim.scene.mechanism import Link, Mechanism

_SHIFTS = {"free": 1.0}
_TURNS = {"free": 1.0, "ball": 1.0}
"""Kinds that move, or turn, any way; others at most along the axis of their kind."""


class Links(nn.Module):
    """Which bodies each body carries, and how each moves on its joint."""

    carried: Tensor
    """Row i is 1 at all bodies that carry body i and at itself, shape (body, body)."""
    parent: Tensor
    """The world is behind the bodies, shape (body,)."""
    arm: Tensor
    """From the centre of mass to the joint in the native frame [m]; 0 of free bodies."""
    shift_axis: Tensor
    turn_axis: Tensor
    shifts: Tensor
    turns: Tensor

    def __init__(self, mechanism: Mechanism) -> None:
        super().__init__()
        count = mechanism.body_count
        links = sorted(mechanism.links, key=lambda link: link.body)
        carried = torch.eye(count).double()
        for link in mechanism.links:  # parents come before children
            if link.parent >= 0:
                carried[link.body] += carried[link.parent]
        kinds = [link.joint.kind if link.joint else "free" for link in links]
        keep(
            self,
            carried=carried,
            parent=torch.tensor([link.parent % (count + 1) for link in links]),
            arm=_table(links, "in_child"),
            shift_axis=_table(links, "axis", "slider"),
            turn_axis=_table(links, "axis", "hinge"),
            shifts=torch.tensor([[_SHIFTS.get(kind, 0.0)] for kind in kinds]).double(),
            turns=torch.tensor([[_TURNS.get(kind, 0.0)] for kind in kinds]).double(),
        )

    def forward(self, state: Tensor, shift: Tensor, turn: Tensor) -> Tensor:
        """Give the twists (batch, body, 6) of bodies that move so on their joints.

        States (batch, body, 13); shifts and turns beside the carrying body's, (batch, body, 3).
        """
        shift = self.shifts * shift + _along(self._turned(self.shift_axis, state), shift)
        turn = self.turns * turn + _along(self._turned(self.turn_axis, state), turn)
        at = state[..., X] + self._turned(self.arm, state)
        whole = self.carried @ turn
        lever = self.carried @ (shift - torch.linalg.cross(turn, at))
        return torch.cat([lever + torch.linalg.cross(whole, state[..., X]), whole], dim=-1)

    def beside(self, values: Tensor) -> Tensor:
        """Subtract the carrying body's vectors from each body's, (batch, body, 3); the world's
        are 0.
        """
        return values - nn.functional.pad(values, (0, 0, 0, 1))[:, self.parent]

    def _turned(self, vectors: Tensor, state: Tensor) -> Tensor:
        return turning.rotate(state[..., Q], vectors)


def _table(links: list[Link], name: str, kind: str = "") -> Tensor:
    """Vectors of the links' joints, 0 of others than a kind and of free bodies."""
    rows = [
        list(getattr(link.joint, name))
        if link.joint and kind in ("", link.joint.kind)
        else [0.0] * 3
        for link in links
    ]
    return torch.tensor(rows, dtype=torch.float64)


def _along(axis: Tensor, vectors: Tensor) -> Tensor:
    return (axis * vectors).sum(-1, keepdim=True) * axis
