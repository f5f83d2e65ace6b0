"""Does the ground's friction keep to Coulomb's law, and does what rolls go on rolling?"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.gains import axles_of, spin_gained
from mbds_xsim.checks.ground import Push, balls_of, pushes_of
from mbds_xsim.checks.record import Record

_LITTLE = 0.05  # of the weight, or of the slip that friction takes in a step
_SPRUNG = 0.01  # of what friction takes in an impact, which springs give back (MuJoCo: 1.2e-3)
_LASTING = 0.2  # of its change, which a slip must keep
_ALIKE = 0.5  # between the direction of a slip and its mean, as vectors
_SURE = 0.9  # of the slip that friction can take in a step
_EVEN = 1e-9  # [m]; also of directions
_STRAIGHT = 0.9  # least share of the heading in the slip of a wheel that slips straight on
_SHARE = 0.5  # of the budget of friction: a wheel's is known better than a group's


@check("friction", "friction")
def friction(record: Record) -> Figures:
    """Hold the horizontal impulse of the ground against μ times the vertical; else None.

    It is never above; and equal, opposite to the slip, while a ball slips through a whole step.
    Over μ times the vertical impulse, or the weight's where that is larger.
    """
    pushes = pushes_of(record)
    parts = [part for push in pushes for part in (_beyond(record, push), _beside(record, push))]
    names = [f"{part}, {push.name}" for push in pushes for part in ("cone", "slip")]
    return Figures(record.by_step(parts), names)


@check("rolling", "rolling")
def rolling(record: Record) -> Figures:
    """Measure the slip of balls that must roll, over the largest speed; None without balls.

    A slip that friction can take away within a step, and hold against the load, is gone at the
    step's end.
    """
    pushes, parts = balls_of(record), []
    for push in pushes:
        body = push.bodies[0]
        speed = np.linalg.norm(record.bodies.velocity[:, :, body], axis=-1)
        fastest = np.maximum(np.nanmax(speed, axis=1, initial=0.0), np.finfo(float).tiny)
        slip = np.linalg.norm(push.over.slip[:, :, 0], axis=-1)
        load = record.batch.force[:, : record.steps, body, :2] * record.frame
        load = load + push.mass * record.frame * np.array(record.scene.gravity[:2])
        drive = np.linalg.norm(load, axis=-1)
        takes = record.ground.friction * push.impulse[..., 2] - drive
        stops = _yielding(record, push) * takes * _SURE > slip[:, :-1] + drive / push.mass
        rolls = stops & push.resting[:, 1:]
        parts.append(np.where(rolls, slip[:, 1:] / fastest[:, None], np.nan))
    return Figures(record.by_step(parts), [push.name for push in pushes])


def _beyond(record: Record, push: Push) -> Array:
    """Impulse beyond the cone, over the larger of the two normal ones, (trajectory, step)."""
    mu, up = record.ground.friction, push.impulse[..., 2]
    across = np.linalg.norm(push.impulse[..., :2], axis=-1)
    beyond = np.maximum(across - mu * np.maximum(up, 0.0) - push.blur, 0.0)
    return np.asarray(beyond / ((mu or 1.0) * np.maximum(up, push.weight)))


def _beside(record: Record, push: Push) -> Array:
    """Impulse less the one of full friction, over this, while a ball slips; else NaN.

    A slip at both ends of a step, alike and no small part of its change, lasted through it, as
    what friction has stopped does not start again. Where it turns, friction is between its ends.
    """
    mu, up = record.ground.friction, push.impulse[..., 2]
    if mu == 0.0 or not push.ball:
        return np.full(up.shape, np.nan)
    slip = push.over.slip[:, :, 0]
    begin, end = slip[:, :-1], slip[:, 1:]
    ahead = [part / np.linalg.norm(part, axis=-1, keepdims=True) for part in (begin, end)]
    toward = ahead[0] + ahead[1]
    toward = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    spread = np.linalg.norm(ahead[0] - toward, axis=-1)
    slowest = np.minimum(*(np.linalg.norm(part, axis=-1) for part in (begin, end)))
    takes = np.maximum(_LITTLE * push.weight, _SPRUNG * up)
    least = mu * takes / push.mass
    slips = slowest > least + _LASTING * np.linalg.norm(end - begin, axis=-1)
    slips &= (spread < _ALIKE) & (up > _LITTLE * push.weight)
    left = push.impulse[..., :2] / (mu * up)[..., None] + toward
    found = np.linalg.norm(left, axis=-1) - spread - push.blur / (mu * up)
    return np.where(slips, np.maximum(found, 0.0), np.nan)


def _yielding(record: Record, push: Push) -> float:
    """Least slip that a horizontal impulse gives a ball's lowest point [1/kg]."""
    mechanism, body = record.mechanism, push.bodies[0]
    radius = float(mechanism.sphere_radius[push.spheres[0]])
    stiffest = float(np.linalg.eigvalsh(mechanism.inertia[body])[-1])
    return 1.0 / push.mass + radius**2 / stiffest


@check("wheels", lambda record: _SHARE * record.scene.budget.friction)
def wheels(record: Record) -> Figures | None:
    """Hold the friction of single wheels against the group's momentum and Coulomb's law.

    A wheel is a body of revolution about its only joint, a hinge, with one contact sphere around
    its centre of mass. Its spin about the axle changes by the hinge's torque and by friction, whose
    lever is the radius: I Δω = τ H − R P. So the impulse P of friction along the wheel's heading is
    known, wheel by wheel, where the ground's impulse on all of them is not.

    Along a common heading the wheels' frictions add up to the ground's; their sizes never to more
    than μ times its vertical impulse, and to just so much while all that touch slip straight on.
    Over μ times the vertical impulse, or the weight's where that is larger. None without wheels.
    """
    found = [push for push in pushes_of(record) if _is_on_wheels(record, push)]
    if not found or not record.ground.friction:
        return None
    parts = [part for push in found for part in _of_wheels(record, push)]
    names = [f"{kind}, {push.name}" for push in found for kind in ("momentum", "cone", "slip")]
    return Figures(record.by_step(parts), names)


def _is_on_wheels(record: Record, push: Push) -> bool:
    """Whether each sphere of a group is around the centre of a body on an axle."""
    offset = np.linalg.norm(record.mechanism.sphere_offset[push.spheres], axis=1)
    placed = {axle.sphere for axle in axles_of(record.mechanism, push)}
    return bool(placed >= set(range(len(push.spheres))) and offset.max() <= _EVEN)


def _of_wheels(record: Record, push: Push) -> tuple[Array, Array, Array]:
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
