"""Between body states and the coordinates of the spanning tree, vectorised over leading axes.

Engines that use reduced coordinates hold, for each link of `Mechanism.links`, the motion of the
body relative to its tree parent. `LinkStates` has that motion in one form for all joint kinds;
an adapter copies the columns its engine wants. The order is that of `Mechanism.links`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.assembly import joint_coordinate
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism

__all__ = ["BodyStates", "LinkStates", "to_bodies", "to_links"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BodyStates:
    """Maximal coordinates with rotations of the native frames, in body order."""

    position: Array
    """Centres of mass in W [m], shape (…, body, 3)."""
    native: Array
    """Rotations of the native frames, shape (…, body, 4)."""
    velocity: Array
    """[m/s], shape (…, body, 3)."""
    angular_velocity: Array
    """In W [rad/s], shape (…, body, 3)."""


@dataclass(frozen=True, eq=False)
class LinkStates:
    """Motion of each body relative to its tree parent, in link order."""

    rotation: Array
    """Native frame of the child to that of the parent (wxyz), shape (…, link, 4)."""
    angular_velocity: Array
    """Of the child relative to the parent, in the child's native frame [rad/s], (…, link, 3)."""
    coordinate: Array
    """Hinge angle in (−π, π] [rad] or slider displacement [m], else 0, shape (…, link)."""
    rate: Array
    """Its rate [rad/s or m/s], else 0, shape (…, link)."""
    position: Array
    """Of a free body's centre of mass in W [m], else 0, shape (…, link, 3)."""
    velocity: Array
    """Of a free body's centre of mass in W [m/s], else 0, shape (…, link, 3)."""


def to_links(mechanism: Mechanism, bodies: BodyStates) -> LinkStates:
    """Express body states in the coordinates of the spanning tree."""
    lead = bodies.position.shape[:-2]
    count = mechanism.body_count
    turn, spin = np.zeros((*lead, count, 4)), np.zeros((*lead, count, 3))
    coordinate, rate = np.zeros((*lead, count)), np.zeros((*lead, count))
    position, velocity = np.zeros((*lead, count, 3)), np.zeros((*lead, count, 3))
    for k, link in enumerate(mechanism.links):
        parent = _moving(bodies, link.parent)
        child = _moving(bodies, link.body)
        back = rotation.conjugate(child.native)
        turn[..., k, :] = rotation.multiply(rotation.conjugate(parent.native), child.native)
        relative = child.angular_velocity - parent.angular_velocity
        spin[..., k, :] = rotation.rotate(back, relative)
        joint = link.joint
        if joint is None:
            position[..., k, :], velocity[..., k, :] = child.position, child.velocity
        elif joint.kind in ("hinge", "slider"):
            coordinate[..., k] = joint_coordinate(joint, bodies.position, bodies.native)
            axis = rotation.rotate(parent.native, joint.axis)
            if joint.kind == "slider":
                arm = child.position - parent.position
                relative = (
                    child.velocity - parent.velocity - rotation.cross(parent.angular_velocity, arm)
                )
            rate[..., k] = np.sum(relative * axis, axis=-1)
    return LinkStates(turn, spin, coordinate, rate, position, velocity)


def to_bodies(mechanism: Mechanism, links: LinkStates) -> BodyStates:
    """Forward kinematics: body states from tree coordinates.

    Ball joints and free bodies read `rotation` and `angular_velocity`, free bodies `position` and
    `velocity` too, hinges and sliders only `coordinate` and `rate`.
    """
    lead = links.coordinate.shape[:-1]
    count = mechanism.body_count
    x, q = np.zeros((*lead, count, 3)), np.zeros((*lead, count, 4))
    v, w = np.zeros((*lead, count, 3)), np.zeros((*lead, count, 3))
    bodies = BodyStates(x, q, v, w)
    for k, link in enumerate(mechanism.links):
        body, joint = link.body, link.joint
        if joint is None:
            x[..., body, :], v[..., body, :] = links.position[..., k, :], links.velocity[..., k, :]
            q[..., body, :] = links.rotation[..., k, :]
            w[..., body, :] = rotation.rotate(q[..., body, :], links.angular_velocity[..., k, :])
            continue
        parent = _moving(bodies, link.parent)
        turn = np.broadcast_to(rotation.IDENTITY, (*lead, 4))
        spin = np.zeros((*lead, 3))
        shift, shift_rate = np.zeros((*lead, 3)), np.zeros((*lead, 3))
        axis = rotation.rotate(parent.native, joint.axis)
        if joint.kind == "ball":
            turn = links.rotation[..., k, :]
        elif joint.kind == "hinge":
            turn = rotation.from_vector(links.coordinate[..., k, None] * joint.axis)
            spin = links.rate[..., k, None] * axis
        elif joint.kind == "slider":
            shift = links.coordinate[..., k, None] * axis
            shift_rate = links.rate[..., k, None] * axis
        q[..., body, :] = rotation.multiply(parent.native, turn)
        if joint.kind == "ball":
            spin = rotation.rotate(q[..., body, :], links.angular_velocity[..., k, :])
        w[..., body, :] = parent.angular_velocity + spin
        to_joint = rotation.rotate(parent.native, joint.in_parent) + shift
        from_joint = rotation.rotate(q[..., body, :], joint.in_child)
        x[..., body, :] = parent.position + to_joint - from_joint
        v[..., body, :] = (
            parent.velocity
            + rotation.cross(parent.angular_velocity, to_joint)
            + shift_rate
            - rotation.cross(w[..., body, :], from_joint)
        )
    return bodies


def _moving(bodies: BodyStates, body: int) -> BodyStates:
    """State of one body, or of the world, with the leading axes kept."""
    if body == WORLD_INDEX:
        lead = bodies.position.shape[:-2]
        zero = np.zeros((*lead, 3))
        return BodyStates(zero, np.broadcast_to(rotation.IDENTITY, (*lead, 4)), zero, zero)
    return BodyStates(
        bodies.position[..., body, :],
        bodies.native[..., body, :],
        bodies.velocity[..., body, :],
        bodies.angular_velocity[..., body, :],
    )
