"""Friction of single wheels, from what their spin shows.

A wheel is a body of revolution about its only joint, a hinge, with one contact sphere around its
centre of mass. Its spin about the axle changes by the hinge's torque and by friction, whose lever
is the radius: I Δω = τ H − R P. So the impulse P of friction along the wheel's heading is known,
wheel by wheel, where the ground's impulse on all of them is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.ground import Push, pushes_of, spheres_of
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EVEN = 1e-9  # relative, of moments of inertia; also lengths [m]
_STRAIGHT = 0.9  # least share of the heading in the slip of a wheel that slips straight on
_LASTING = 0.2  # of its change, which a slip must keep
_LITTLE = 0.05  # of the weight
_SHARE = 0.5  # of the budget of friction: a wheel's is known better than a group's


@dataclass(frozen=True, eq=False)
class _Wheels:
    """All wheels of a group that stands on nothing else; axes are (…, wheel)."""

    body: NDArray[np.int64]
    hinge: NDArray[np.int64]
    sign: Array
    """Of the torque on the wheel: −1 where it is the hinge's parent."""
    moment: Array
    """About the axle [kg·m²]."""
    axle: Array
    """In native frames, shape (wheel, 3)."""


def wheels(record: Record) -> Finding | None:
    """Hold the friction of single wheels against the group's momentum and Coulomb's law.

    Along a common heading the wheels' frictions add up to the ground's; their sizes never to more
    than μ times its vertical impulse, and to just so much while all that touch slip straight on.
    Over μ times the vertical impulse, or the weight's where that is larger. None without wheels.
    """
    found = [
        (push, placed)
        for push in pushes_of(record)
        if (placed := _wheels_of(record.mechanism, push)) is not None
    ]
    if not found or not record.scene.ground or not record.scene.ground.friction:
        return None
    parts = [part for push, placed in found for part in _parts(record, push, placed)]
    series = np.full((*record.finite.shape, len(parts)), np.nan)
    series[:, 1:] = np.stack(parts, axis=-1)
    series[:, 0] = 0.0
    kinds = ("momentum", "cone", "slip")
    return Finding.of(
        "wheels",
        "1",
        series,
        budget=_SHARE * record.scene.budget.friction,
        names=tuple(f"{kind}, {push.name}" for push, _ in found for kind in kinds),
    )


def _wheels_of(mechanism: Mechanism, push: Push) -> _Wheels | None:
    placed = [_hinge_of(mechanism, sphere) for sphere in push.spheres]
    if push.ball or None in placed:
        return None
    body = mechanism.sphere_body[push.spheres]
    hinges = np.array([hinge for hinge in placed if hinge is not None], dtype=np.int64)
    joints = [mechanism.hinges[hinge] for hinge in hinges]
    axle = np.array([joint.axis for joint in joints])
    return _Wheels(
        body=body,
        hinge=hinges,
        sign=np.array([1.0 if j.child == b else -1.0 for j, b in zip(joints, body, strict=True)]),
        moment=np.einsum("wi,wij,wj->w", axle, mechanism.inertia[body], axle),
        axle=axle,
    )


def _hinge_of(mechanism: Mechanism, sphere: int) -> int | None:
    """Hinge on whose axle a sphere's body is a wheel, by its number among the hinges."""
    body = int(mechanism.sphere_body[sphere])
    mine = [joint for joint in mechanism.joints if body in (joint.parent, joint.child)]
    tied = any(body in pair.bodies for pair in (*mechanism.distances, *mechanism.springs))
    if tied or len(mine) != 1 or mine[0].kind != "hinge":
        return None
    joint, inertia = mine[0], mechanism.inertia[body]
    anchor = joint.in_child if joint.child == body else joint.in_parent
    moment = float(joint.axis @ inertia @ joint.axis)
    across = (np.trace(inertia) - moment) / 2
    outer = np.outer(joint.axis, joint.axis)
    even = np.abs(inertia - across * np.eye(3) - (moment - across) * outer).max()
    centred = np.linalg.norm(mechanism.sphere_offset[sphere]) <= _EVEN
    on_axle = np.linalg.norm(np.cross(joint.axis, anchor)) <= _EVEN
    alone = np.count_nonzero(mechanism.sphere_body == body) == 1
    if not (centred and on_axle and alone and even <= _EVEN * moment):
        return None
    return mechanism.hinges.index(joint)


def _parts(record: Record, push: Push, placed: _Wheels) -> tuple[Array, Array, Array]:
    """Deviations from momentum, cone and slip, each (trajectory, step)."""
    friction, heading, turned = _frictions(record, push, placed)
    assert record.scene.ground is not None
    most = record.scene.ground.friction * push.impulse[..., 2]
    weight = push.mass * float(np.linalg.norm(record.scene.gravity)) * record.frame
    scale = np.maximum(most, record.scene.ground.friction * weight)
    total = np.abs(friction).sum(axis=2)
    # Directions are known up to their change within the step.
    open_ = (turned * np.abs(friction)).sum(axis=2) + push.blur
    common = heading.mean(axis=2)
    apart = np.linalg.norm(heading - common[:, :, None], axis=-1).max(axis=2)
    along = np.sum(common * push.impulse[..., :2], axis=-1)
    aside = turned.max(axis=2) * np.linalg.norm(push.impulse[..., :2], axis=-1)
    off = np.maximum(np.abs(friction.sum(axis=2) - along) - open_ - aside, 0.0)
    beyond = np.maximum(total - np.maximum(most, 0.0) - open_, 0.0)
    slips, share = _slipping(record, push, heading)
    short = np.maximum(share * most - total - open_, 0.0)
    return (
        np.where(apart < _EVEN + turned.max(axis=2), off, np.nan) / scale,
        beyond / scale,
        np.where(slips & (most > _LITTLE * scale), short, np.nan) / scale,
    )


def _frictions(record: Record, push: Push, placed: _Wheels) -> tuple[Array, Array, Array]:
    """Impulses along headings [N·s], headings (…, wheel, 2), and how far these turn in a step."""
    bodies, radius = record.bodies, record.mechanism.sphere_radius[push.spheres]
    axle = rotation.rotate(bodies.native[:, :, placed.body], placed.axle)
    spin = placed.moment * np.sum(axle * bodies.angular_velocity[:, :, placed.body], axis=-1)
    drive = placed.sign * record.batch.torque[:, : record.steps, placed.hinge] * record.frame
    # The heading, axle × z, is as long as the lever of friction is to the radius.
    heading = np.stack([axle[..., 1], -axle[..., 0]], axis=-1)
    middle = (heading[:, 1:] + heading[:, :-1]) / 2
    level = np.linalg.norm(middle, axis=-1)
    # A wheel that lies flat has none: near there it turns by more than can be followed.
    turned = np.linalg.norm(np.diff(heading, axis=1), axis=-1) / level
    friction = (drive - np.diff(spin, axis=1)) / (radius * level)
    return friction, middle / level[..., None], turned


def _slipping(record: Record, push: Push, heading: Array) -> tuple[Mask, Array]:
    """Steps through which all wheels that touch slip straight on, and the least heading's share."""
    slip = spheres_of(record.mechanism, record.bodies).slip[:, :, push.spheres]
    size = np.linalg.norm(slip, axis=-1)
    along = [np.sum(heading * part, axis=-1) for part in (slip[:, :-1], slip[:, 1:])]
    slowest = np.minimum(size[:, :-1], size[:, 1:])
    change = np.linalg.norm(np.diff(slip, axis=1), axis=-1)
    share = np.minimum(np.abs(along[0]) / size[:, :-1], np.abs(along[1]) / size[:, 1:])
    fall = record.frame * float(np.linalg.norm(record.scene.gravity))
    lasts = (along[0] * along[1] > 0.0) & (slowest > _LASTING * change + _LITTLE * fall)
    every = (lasts & (share > _STRAIGHT) & push.reach).all(axis=2)
    return every & push.supported, share.min(axis=2)
