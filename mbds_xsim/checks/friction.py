"""Does the ground's friction follow Coulomb's law, and do rolling balls keep rolling?"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.gains import axles_of, spin_gain
from mbds_xsim.checks.ground import Push, balls_of, pushes_of
from mbds_xsim.checks.record import Record

_LITTLE = 0.05  # share of the weight, or of the slip that friction takes in a step
_SPRING_SHARE = 0.01  # share of an impact's friction that springs give back (MuJoCo: 1.2e-3)
_LASTING = 0.2  # share of its change that a slip must exceed
_ALIKE = 0.5  # largest distance of a slip's unit vector from the mean one
_SURE = 0.9  # share of the slip that friction can take in a step
_EVEN = 1e-9  # tolerance [m]; also of directions
_STRAIGHT = 0.9  # least share of the heading in the slip of a wheel that slips straight on
_SHARE = 0.5  # share of the budget of friction: a wheel's is known better than a group's


@check("friction", "friction")
def friction(record: Record) -> Figures:
    """Compare the ground's horizontal impulse with μ times the vertical; None without contact.

    It must never be larger. While a ball slips through a whole step it must be equal, and opposite
    to the slip. The scale is μ times the vertical impulse, or the weight's if that is larger.
    """
    pushes = pushes_of(record)
    parts = [part for push in pushes for part in (_beyond(record, push), _beside(record, push))]
    names = [f"{part}, {push.name}" for push in pushes for part in ("cone", "slip")]
    return Figures(record.by_step(parts), names)


@check("rolling", "rolling")
def rolling(record: Record) -> Figures:
    """Measure the slip of balls that must roll, over the largest speed; None without balls.

    A slip that friction can stop within a step, and keep stopped against the load, must be gone at
    the step's end.
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
        slips = slip[:, :-1] + drive / push.mass + _tumbling(record, push)
        stops = _yielding(record, push) * takes * _SURE > slips
        rolls = stops & push.resting[:, 1:]
        parts.append(np.where(rolls, slip[:, 1:] / fastest[:, None], np.nan))
    return Figures(record.by_step(parts), [push.name for push in pushes])


def _beyond(record: Record, push: Push) -> Array:
    """Compute the impulse beyond the cone over the friction scale, (trajectory, step)."""
    mu, up = record.ground.friction, push.impulse[..., 2]
    across = np.linalg.norm(push.impulse[..., :2], axis=-1)
    excess = np.maximum(across - mu * np.maximum(up, 0.0) - push.blur, 0.0)
    return np.asarray(excess / ((mu or 1.0) * np.maximum(up, push.weight)))


def _beside(record: Record, push: Push) -> Array:
    """Compute the deviation from full friction, relative, while a ball slips; else NaN.

    A slip that is alike at both ends of a step, and not small against its change, lasted through
    the step: once stopped, nothing but unequal moments starts it again. If it turns, so does
    friction in between.
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
    takes = np.maximum(_LITTLE * push.weight, _SPRING_SHARE * up)
    aside = _tumbling(record, push) + _swaying(record, push, toward)
    least = mu * takes / push.mass + aside
    slips = slowest > least + _LASTING * np.linalg.norm(end - begin, axis=-1)
    slips &= (spread < _ALIKE) & (up > _LITTLE * push.weight)
    residual = push.impulse[..., :2] / (mu * up)[..., None] + toward
    turned = spread + aside / slowest
    deviation = np.linalg.norm(residual, axis=-1) - turned - push.blur / (mu * up)
    return np.where(slips, np.maximum(deviation, 0.0), np.nan)


def _tumbling(record: Record, push: Push) -> Array:
    """Bound the slip that unequal moments of a ball give its lowest point in a step [m/s].

    By Euler's equations, without moments, its spin changes in the step at most as fast as at the
    ends, plus their difference; the more it turns in the step, the faster in between.
    """
    mechanism, body = record.mechanism, push.bodies[0]
    spin = record.spin[:, :, body]
    moment = rotation.cross(record.turning[:, :, body], spin)
    change = np.linalg.solve(mechanism.inertia[body], moment[..., None])[..., 0]
    rate, size = rotation.norm(change), rotation.norm(spin)
    fastest = np.maximum(rate[:, 1:], rate[:, :-1]) + rotation.norm(np.diff(change, axis=1))
    turn = np.maximum(size[:, 1:], size[:, :-1]) * record.frame
    return mechanism.sphere_radius[push.spheres[0]] * record.frame * fastest * (1.0 + turn / 2.0)


def _swaying(record: Record, push: Push, toward: Array) -> Array:
    """Bound how far the slip sways in a step as unequal moments turn under friction [m/s].

    What friction changes it by follows the inverse inertia, which changes at most by its range.
    Whenever in the step that happens, it moves the slip off the straight course between the ends by
    at most a quarter of what the whole change would add in a step.
    """
    mechanism, body = record.mechanism, push.bodies[0]
    inverse, rates = np.linalg.inv(mechanism.inertia[body]), []
    torque = np.stack([-toward[..., 1], toward[..., 0], np.zeros(toward.shape[:-1])], axis=-1)
    for ends in (slice(None, -1), slice(1, None)):
        axis = rotation.rotate(rotation.conjugate(record.bodies.native[:, ends, body]), torque)
        spin = record.spin[:, ends, body]
        rate = rotation.cross(spin, axis @ inverse) - rotation.cross(spin, axis) @ inverse
        rates.append(rotation.norm(rate))
    change = np.minimum(record.frame * np.maximum(*rates), np.ptp(np.linalg.eigvalsh(inverse)))
    radius, takes = mechanism.sphere_radius[push.spheres[0]], push.impulse[..., 2]
    return np.asarray(radius**2 * record.ground.friction * takes * change / 4.0)


def _yielding(record: Record, push: Push) -> float:
    """Return the least slip of a ball's lowest point per unit horizontal impulse [1/kg]."""
    mechanism, body = record.mechanism, push.bodies[0]
    radius = float(mechanism.sphere_radius[push.spheres[0]])
    stiffest = float(np.linalg.eigvalsh(mechanism.inertia[body])[-1])
    return 1.0 / push.mass + radius**2 / stiffest


@check("wheels", lambda record: _SHARE * record.scene.budget.friction)
def wheels(record: Record) -> Figures | None:
    """Compare the friction of single wheels with the group's momentum and Coulomb's law.

    A wheel is a body of revolution about its only joint, a hinge, with one contact sphere around
    its centre of mass. Its spin about the axle changes by the hinge's torque and by friction, whose
    lever is the radius: I Δω = τ H − R P. So the impulse P of friction along the wheel's heading is
    known for each wheel, while the ground's other impulses are known only as a sum.

    Along a common heading the wheels' frictions must add up to the ground's. Their sizes must add
    up to at most μ times its vertical impulse, and to just that while all wheels touch and slip
    straight on. The scale is μ times the vertical impulse, or the weight's if that is larger. None
    without wheels or friction.
    """
    pushes = [push for push in pushes_of(record) if _is_on_wheels(record, push)]
    if not pushes or not record.ground.friction:
        return None
    parts = [part for push in pushes for part in _of_wheels(record, push)]
    names = [f"{kind}, {push.name}" for push in pushes for kind in ("momentum", "cone", "slip")]
    return Figures(record.by_step(parts), names)


def _is_on_wheels(record: Record, push: Push) -> bool:
    """Return whether each sphere of a group is around the centre of a body on an axle."""
    offset = np.linalg.norm(record.mechanism.sphere_offset[push.spheres], axis=1)
    on_axles = {axle.sphere for axle in axles_of(record.mechanism, push)}
    return bool(on_axles >= set(range(len(push.spheres))) and offset.max() <= _EVEN)


def _of_wheels(record: Record, push: Push) -> tuple[Array, Array, Array]:
    """Compute deviations from momentum, cone and slip, each (trajectory, step)."""
    friction, heading, heading_change = _frictions(record, push)
    most = record.ground.friction * push.impulse[..., 2]
    scale = np.maximum(most, record.ground.friction * push.weight)
    total = np.abs(friction).sum(axis=2)
    # Directions are known up to their change within the step.
    tolerance = (heading_change * np.abs(friction)).sum(axis=2) + push.blur
    common = heading.mean(axis=2)
    spread = np.linalg.norm(heading - common[:, :, None], axis=-1).max(axis=2)
    along = np.sum(common * push.impulse[..., :2], axis=-1)
    aside = heading_change.max(axis=2) * np.linalg.norm(push.impulse[..., :2], axis=-1)
    deviation = np.maximum(np.abs(friction.sum(axis=2) - along) - tolerance - aside, 0.0)
    excess = np.maximum(total - np.maximum(most, 0.0) - tolerance, 0.0)
    slips, share = _slipping(record, push, heading)
    shortfall = np.maximum(share * most - total - tolerance, 0.0)
    return (
        np.where(spread < _EVEN + heading_change.max(axis=2), deviation, np.nan) / scale,
        excess / scale,
        np.where(slips & (most > _LITTLE * scale), shortfall, np.nan) / scale,
    )


def _frictions(record: Record, push: Push) -> tuple[Array, Array, Array]:
    """Return friction impulses [N·s], headings (…, wheel, 2), and headings' changes in a step."""
    by_sphere = {axle.sphere: axle for axle in axles_of(record.mechanism, push)}
    axles = [by_sphere[k] for k in range(len(push.spheres))]
    radius = np.array([axle.radius for axle in axles])
    axis = record.bodies.arms([axle.body for axle in axles], np.array([a.axis for a in axles]))
    # The length of the heading, axis × z, is the lever of friction over the radius.
    heading = np.stack([axis[..., 1], -axis[..., 0]], axis=-1)
    middle = (heading[:, 1:] + heading[:, :-1]) / 2
    level = np.linalg.norm(middle, axis=-1)
    # A wheel that lies flat has no heading: near there it turns too fast to be followed.
    heading_change = np.linalg.norm(np.diff(heading, axis=1), axis=-1) / level
    spin = np.stack([spin_gain(record, axle) for axle in axles], axis=-1)
    friction = -spin / (radius * level)
    return friction, middle / level[..., None], heading_change


def _slipping(record: Record, push: Push, heading: Array) -> tuple[Mask, Array]:
    """Find steps in which all wheels slip straight on, and the least share of the heading."""
    slip = push.over.slip
    size = np.linalg.norm(slip, axis=-1)
    along = [np.sum(heading * part, axis=-1) for part in (slip[:, :-1], slip[:, 1:])]
    slowest = np.minimum(size[:, :-1], size[:, 1:])
    change = np.linalg.norm(np.diff(slip, axis=1), axis=-1)
    share = np.minimum(np.abs(along[0]) / size[:, :-1], np.abs(along[1]) / size[:, 1:])
    lasts = (along[0] * along[1] > 0.0) & (slowest > _LASTING * change + _LITTLE * record.fall)
    all_slip = (lasts & (share > _STRAIGHT) & push.reach).all(axis=2)
    return all_slip & push.supported, share.min(axis=2)
