"""Friction of single wheels, from what their spin shows.

A wheel is a body of revolution about its only joint, a hinge, with one contact sphere around its
centre of mass. Its spin about the axle changes by the hinge's torque and by friction, whose lever
is the radius: I Δω = τ H − R P. So the impulse P of friction along the wheel's heading is known,
wheel by wheel, where the ground's impulse on all of them is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.gains import axles_of, spin_gained
from mbds_xsim.checks.ground import Push, pushes_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EVEN = 1e-9  # [m]; also of directions
_STRAIGHT = 0.9  # least share of the heading in the slip of a wheel that slips straight on
_LASTING = 0.2  # of its change, which a slip must keep
_LITTLE = 0.05  # of the weight
_SHARE = 0.5  # of the budget of friction: a wheel's is known better than a group's


def wheels(record: Record) -> Finding | None:
    """Hold the friction of single wheels against the group's momentum and Coulomb's law.

    Along a common heading the wheels' frictions add up to the ground's; their sizes never to more
    than μ times its vertical impulse, and to just so much while all that touch slip straight on.
    Over μ times the vertical impulse, or the weight's where that is larger. None without wheels.
    """
    found = [push for push in pushes_of(record) if _is_on_wheels(record, push)]
    if not found or not record.ground.friction:
        return None
    parts = [part for push in found for part in _parts(record, push)]
    kinds = ("momentum", "cone", "slip")
    return Finding.of(
        "wheels",
        "1",
        record.by_step(parts),
        budget=_SHARE * record.scene.budget.friction,
        names=tuple(f"{kind}, {push.name}" for push in found for kind in kinds),
    )


def _is_on_wheels(record: Record, push: Push) -> bool:
    """Whether each sphere of a group is around the centre of a body on an axle."""
    offset = np.linalg.norm(record.mechanism.sphere_offset[push.spheres], axis=1)
    placed = {axle.sphere for axle in axles_of(record.mechanism, push)}
    return bool(placed >= set(range(len(push.spheres))) and offset.max() <= _EVEN)


def _parts(record: Record, push: Push) -> tuple[Array, Array, Array]:
    """Deviations from momentum, cone and slip, each (trajectory, step)."""
    friction, heading, turned = _frictions(record, push)
    most = record.ground.friction * push.impulse[..., 2]
    scale = np.maximum(most, record.ground.friction * push.weight)
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


def _frictions(record: Record, push: Push) -> tuple[Array, Array, Array]:
    """Impulses along headings [N·s], headings (…, wheel, 2), and how far these turn in a step."""
    placed = {axle.sphere: axle for axle in axles_of(record.mechanism, push)}
    axles = [placed[k] for k in range(len(push.spheres))]
    radius = np.array([axle.radius for axle in axles])
    axis = record.bodies.arms([axle.body for axle in axles], np.array([a.axis for a in axles]))
    # The heading, axis × z, is as long as the lever of friction is to the radius.
    heading = np.stack([axis[..., 1], -axis[..., 0]], axis=-1)
    middle = (heading[:, 1:] + heading[:, :-1]) / 2
    level = np.linalg.norm(middle, axis=-1)
    # A wheel that lies flat has none: near there it turns by more than can be followed.
    turned = np.linalg.norm(np.diff(heading, axis=1), axis=-1) / level
    spin = np.stack([spin_gained(record, axle) for axle in axles], axis=-1)
    friction = -spin / (radius * level)
    return friction, middle / level[..., None], turned


def _slipping(record: Record, push: Push, heading: Array) -> tuple[Mask, Array]:
    """Steps through which all wheels that touch slip straight on, and the least heading's share."""
    slip = push.over.slip
    size = np.linalg.norm(slip, axis=-1)
    along = [np.sum(heading * part, axis=-1) for part in (slip[:, :-1], slip[:, 1:])]
    slowest = np.minimum(size[:, :-1], size[:, 1:])
    change = np.linalg.norm(np.diff(slip, axis=1), axis=-1)
    share = np.minimum(np.abs(along[0]) / size[:, :-1], np.abs(along[1]) / size[:, 1:])
    lasts = (along[0] * along[1] > 0.0) & (slowest > _LASTING * change + _LITTLE * record.fall)
    every = (lasts & (share > _STRAIGHT) & push.reach).all(axis=2)
    return every & push.supported, share.min(axis=2)
