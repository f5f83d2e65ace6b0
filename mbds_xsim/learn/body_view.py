"""View of a frame that networks of bodies see: vectors and scalars of bodies, joints, contacts.

It describes the state and the result of smooth motion over the frame (`BodyMechanics.smooth`): the
twists at its end, and the gaps that contact spheres would have then. Vectors are in W and turn with
the scene; scalars do not change. Velocities are in units of the deviation of displacements per
frame time, their changes in units of that of second differences; spins are multiplied by their
body's radius of gyration about its joint.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mbds_xsim.learn import turning
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.layers import TensorModule, keep
from mbds_xsim.learn.rigid import Links, Q, V, W, X
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.scene.mechanism import JointKind

_KINDS: tuple[JointKind, ...] = ("fixed", "hinge", "slider", "ball")
_FINE = 1e-3  # of the scene's length: gaps that decide on support


@dataclass(frozen=True, eq=False)
class Seen:
    """Vectors (batch, item, channel, 3) and scalars (batch, item, scalar) of one kind of item.

    Both are in single precision, like the networks; differences are taken in double first.
    """

    vectors: Tensor
    scalars: Tensor

    @staticmethod
    def of(vectors: Sequence[Tensor], scalars: Tensor) -> Seen:
        """Stack vectors (batch, item, 3) and convert all to single precision."""
        return Seen(torch.stack([*vectors], dim=-2).float(), scalars.float())

    @property
    def flat(self) -> Tensor:
        """Components of the vectors, then the scalars, shape (batch, item, number)."""
        return torch.cat([self.vectors.flatten(2), self.scalars], dim=-1)


@dataclass(frozen=True, eq=False)
class BodyView:
    """Everything that a network sees of a frame, computed as far as it looks."""

    viewer: BodyViewer
    states: Sequence[Tensor]
    """States at the steps of the smooth frame, each (batch, body, 13), without gradients."""

    @functools.cached_property
    def bodies(self) -> Seen:
        """Bodies, in the order of the scene."""
        middle = self.states[len(self.states) // 2]
        return self.viewer.bodies(self.states[0], middle, self.states[-1])

    @functools.cached_property
    def joints(self) -> Seen:
        """Each joint as seen from every body that it holds, which is the receiving end."""
        return self.viewer.joints(self.states[-1])

    @property
    def contacts(self) -> Seen:
        """Contact spheres."""
        return self._touched[0]

    @property
    def arm(self) -> Tensor:
        """Vector from the centre of mass to the sphere's lowest point [m], (batch, contact, 3)."""
        return self._touched[1]

    @functools.cached_property
    def _touched(self) -> tuple[Seen, Tensor]:
        return self.viewer.contacts(self.states[0], self.states[-1])


class BodyViewer(TensorModule):
    """Module that computes the views of one scene."""

    BODY, JOINT, CONTACT = 12, 5, 4
    """Numbers of vectors: of a body (velocity, spin, spin on its joint; their changes in smooth
    motion; second-half minus first-half changes; its axes), of a joint (arm to it, vector between
    the bodies, relative velocity and spin, the joint's axis), of a contact (velocities of the
    lowest point at start and end, arm, spin)."""
    BODY_SCALARS, JOINT_SCALARS, CONTACT_SCALARS = 4, len(_KINDS), 8

    speed: Tensor
    """Unit of velocities [m/s]."""
    change: Tensor
    """Unit of velocity changes [m/s]."""
    senders: Tensor
    """Body at the other end of the joint of each end; the world follows the bodies, (end,)."""
    depth: Tensor
    """Radius of each sphere as a vertical vector [m], shape (contact, 3)."""

    def __init__(self, graph: Graph, statistics: Statistics) -> None:
        super().__init__()
        mechanism, world = graph.mechanism, graph.body_count
        self.links = Links(mechanism)
        self.length, self.frame_s = graph.length, graph.frame_s
        mass, inertia = torch.from_numpy(mechanism.mass), torch.from_numpy(mechanism.inertia)
        moments = inertia.diagonal(dim1=-2, dim2=-1)
        square = 0.5 * moments.sum(-1) / mass
        ends = [end for joint in mechanism.joints for end in (joint, joint.turned_round())]
        ends = [end for end in ends if end.child >= 0]
        arms = [[*end.in_child, *end.in_parent, *end.axis] for end in ends]
        keep(
            self,
            radius=(square + self.links.arm.square().sum(-1)).sqrt()[:, None],
            shape=torch.cat([(mass / mass.mean())[:, None], moments / (mass * square)[:, None]], 1),
            receivers=torch.tensor([end.child for end in ends], dtype=torch.int64),
            senders=torch.tensor([e.parent % (world + 1) for e in ends], dtype=torch.int64),
            arms=torch.tensor(arms, dtype=torch.float64).reshape(-1, 3, 3),
            kind=torch.eye(len(_KINDS)).double()[[_KINDS.index(end.kind) for end in ends]],
            sphere_body=torch.from_numpy(mechanism.sphere_body),
            sphere=torch.from_numpy(mechanism.sphere_offset),
            depth=torch.from_numpy(mechanism.sphere_radius[:, None] * np.array([0.0, 0.0, 1.0])),
        )
        for name, moments_of in (("speed", "displacement"), ("change", "acceleration")):
            spread = getattr(statistics, moments_of).spread(graph.moving) / graph.frame_s
            self.register_buffer(name, torch.tensor(spread, dtype=torch.float64))

    def contacts(self, before: Tensor, after: Tensor) -> tuple[Seen, Tensor]:
        """Return the view of the contacts, and their arms after the frame."""
        first, start, _ = self.touch(before)
        gap, end, arm = self.touch(after)
        radius, speed = self.radius[self.sphere_body], self.speed
        spin = after[:, self.sphere_body, W] * radius
        contacts = [start / speed, end / speed, arm / radius, spin / speed]
        gaps = self._gaps(first, gap, start[..., 2:], end[..., 2:])
        return Seen.of(contacts, gaps), arm

    def bodies(self, before: Tensor, middle: Tensor, after: Tensor) -> Seen:
        """Return the view of the bodies."""
        bend = after - 2.0 * middle + before
        motions = (before, self.speed), (after - before, self.change), (bend, self.change)
        vectors = [
            vector / unit
            for state, unit in motions
            for spin in (state[..., W] * self.radius,)
            for vector in (state[..., V], spin, self.links.beside(state[..., W]) * self.radius)
        ]
        frame = turning.matrix(after[..., Q]).mT
        return Seen.of([*vectors, *frame.unbind(-2)], self.shape.expand(len(after), -1, -1))

    def joints(self, state: Tensor) -> Seen:
        """Return the view of the joints, after the frame."""
        world = state.new_zeros(len(state), 1, 13)
        world[..., 3] = 1.0
        states = torch.cat([state, world], dim=1)
        own, other = states[:, self.receivers], states[:, self.senders]
        radius = self.radius[self.receivers]
        vectors = [
            turning.rotate(own[..., Q], self.arms[:, 0]) / radius,
            (own[..., X] - other[..., X]) / radius,
            (own[..., V] - other[..., V]) / self.speed,
            (own[..., W] - other[..., W]) * radius / self.speed,
            turning.rotate(own[..., Q], self.arms[:, 2]),
        ]
        return Seen.of(vectors, self.kind.expand(len(state), -1, -1))

    def touch(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return gaps (batch, contact, 1) [m], the lowest points' velocities [m/s] and arms [m]."""
        body = state[:, self.sphere_body]
        arm = turning.rotate(body[..., Q], self.sphere) - self.depth
        velocity = body[..., V] + torch.linalg.cross(body[..., W], arm)
        return body[..., 2:3] + arm[..., 2:], velocity, arm

    def _gaps(self, start: Tensor, end: Tensor, start_rate: Tensor, end_rate: Tensor) -> Tensor:
        """Return scalars of contacts: gaps in two units, depth, share of frame to touch, and rates.

        Rates are the vertical velocities of the lowest points, negative downwards.
        """
        unit = self.change * self.frame_s
        share = (start / (start - end).clamp(min=1e-9)).clamp(0.0, 1.0)
        fine = _FINE * self.length
        return torch.cat(
            [
                torch.asinh(start / unit), torch.asinh(end / unit),
                torch.asinh(start / fine), torch.asinh(end / fine),
                (-end).clamp(min=0.0) / unit, share,
                start_rate / self.speed, end_rate / self.speed,
            ],
            dim=-1,
        )  # fmt: skip
