"""Does the ground's friction keep to Coulomb's law, and does what rolls go on rolling?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.ground import Push, pushes_of

Array = NDArray[np.float64]

_LITTLE = 0.05  # of the weight, or of the slip that friction takes in a step
_SPRUNG = 0.01  # of what friction takes in an impact, which springs give back (MuJoCo: 1.2e-3)
_LASTING = 0.2  # of its change, which a slip must keep
_ALIKE = 0.5  # between the direction of a slip and its mean, as vectors
_SURE = 0.9  # of the slip that friction can take in a step


def friction(record: Record) -> Finding | None:
    """Hold the horizontal impulse of the ground against μ times the vertical; else None.

    It is never above; and equal, opposite to the slip, while a ball slips through a whole step.
    Over μ times the vertical impulse, or the weight's where that is larger.
    """
    pushes = pushes_of(record)
    if not pushes:
        return None
    parts = [part for push in pushes for part in (_beyond(record, push), _beside(record, push))]
    return Finding.of(
        "friction",
        "1",
        record.by_step(parts),
        budget=record.scene.budget.friction,
        names=tuple(f"{part}, {push.name}" for push in pushes for part in ("cone", "slip")),
    )


def rolling(record: Record) -> Finding | None:
    """Measure the slip of balls that must roll, over the largest speed; None without balls.

    A slip that friction can take away within a step, and hold against the load, is gone at the
    step's end.
    """
    pushes = [push for push in pushes_of(record) if push.ball]
    if not pushes:
        return None
    parts = []
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
    return Finding.of(
        "rolling",
        "1",
        record.by_step(parts),
        budget=record.scene.budget.rolling,
        names=tuple(push.name for push in pushes),
    )


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
