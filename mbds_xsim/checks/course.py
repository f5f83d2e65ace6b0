"""The course of an impact on a compliant contact, from its normal impulse alone.

Impulse builds up until the sphere leaves. Friction opposes the slip of each moment, μ times the
normal impulse, or holds the point where that is enough (Routh 1905, Dynamics of a System of Rigid
Bodies; in three dimensions Keller 1986, J. Appl. Mech. 53, 1). Nothing is assumed of the spring
but that its push is half a sine in time, which only matters for what rotation and gravity add.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.checks.finding import Record
from mbds_xsim.checks.impacts import Impacts, followed, one_sphere
from mbds_xsim.checks.response import lowest, pushed
from mbds_xsim.scene.joint_space import BodyStates

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_PARTS = 200  # of an impact
_MOMENT = 1e-6  # over which accelerations are differences [s]
_STILL = 1e-9  # slip that has no direction [m/s]


@dataclass(frozen=True, eq=False)
class Course:
    """What an impact comes to, one entry an impact."""

    velocity: Array
    """Of the sphere's lowest point at the end [m/s], shape (impact, 3)."""
    friction: Array
    """Horizontal impulse [N·s], shape (impact, 2)."""
    restitution: Array
    """Root of the normal work given back over the work taken (Stronge 1990, Proc. R. Soc. A 431,
    169)."""


@functools.lru_cache(maxsize=4)
def course_of(record: Record, hits: Impacts, coefficient: float) -> Course:
    """Follow impacts through their recorded normal impulse, with a coefficient of friction."""
    ends = (hits.before, hits.after)
    yields = [yielding(record, bodies, hits.sphere) for bodies in ends]
    pulls = [_acceleration(record, hits, bodies) for bodies in ends]
    duration = np.maximum(hits.duration, 0.0)[:, None] / _PARTS
    velocity = np.column_stack([hits.slip, -hits.arriving])
    friction = np.zeros((len(velocity), 2))
    work = np.zeros((2, len(velocity)))
    for k in range(_PARTS):
        share = (k + 0.5) / _PARTS
        gives = (1.0 - share) * yields[0] + share * yields[1]
        alone = ((1.0 - share) * pulls[0] + share * pulls[1]) * duration
        up = hits.impulse[:, 2] * np.diff(-0.5 * np.cos(np.pi * np.array([k, k + 1]) / _PARTS))
        alone = alone + gives[:, :, 2] * up[:, None]
        across = _friction(velocity[:, :2], gives, alone, coefficient * up)
        change = alone + np.einsum("kij,kj->ki", gives[:, :, :2], across)
        speed = velocity[:, 2] + 0.5 * change[:, 2]
        work += up * np.stack([np.maximum(-speed, 0.0), np.maximum(speed, 0.0)])
        velocity, friction = velocity + change, friction + across
    return Course(velocity, friction, np.sqrt(work[1] / work[0]))


def yielding(record: Record, bodies: BodyStates, sphere: Index) -> Array:
    """Velocity that a unit impulse on a sphere's lowest point gives it [1/kg], (impact, 3, 3)."""
    if not len(sphere):
        return np.zeros((0, 3, 3))
    mechanism, each = record.mechanism, np.arange(len(sphere))
    body = mechanism.sphere_body[sphere]
    given = pushed(mechanism, bodies, sphere)
    arm = lowest(mechanism, bodies.native[each, body], sphere)[:, None]
    turning = rotation.cross(given.angular_velocity[each, :, body], arm)
    return np.moveaxis(given.velocity[each, :, body] + turning, 1, 2)


def _acceleration(record: Record, hits: Impacts, bodies: BodyStates) -> Array:
    """Of the lowest point without the ground [m/s²], shape (impact, 3)."""
    inputs = (values[hits.row, hits.step] for values in (record.batch.force, record.batch.torque))
    force, torque = inputs
    ends = []
    for moment in (-_MOMENT, _MOMENT):
        moments = np.full(len(hits.row), moment)
        there = followed(record, bodies, force, torque, moments)
        point = one_sphere(record, there, hits.sphere)
        ends.append(np.column_stack([point.slip, point.climb]))
    return np.asarray((ends[1] - ends[0]) / (2.0 * _MOMENT))


def _friction(slip: Array, gives: Array, alone: Array, most: Array) -> Array:
    """Impulse of friction in a part [N·s], (impact, 2): it holds the point, or opposes its slip.

    Args:
        slip: At the part's start [m/s], shape (impact, 2).
        gives: As of `yielding`.
        alone: Change of velocity that the rest makes [m/s], shape (impact, 3).
        most: Largest size of the impulse [N·s].
    """
    soft = gives[:, :2, :2]
    holds = np.asarray(
        np.linalg.solve(soft, -(slip + alone[:, :2])[..., None])[..., 0], dtype=float
    )
    needed = np.linalg.norm(holds, axis=1)
    ahead = np.einsum("kij,kj->ki", soft, _direction(slip)) * most[:, None]
    middle = _direction(slip + 0.5 * (alone[:, :2] - ahead))
    still = np.linalg.norm(slip, axis=1) < _STILL
    against = np.where(still[:, None], _direction(holds), -middle)
    return np.where((needed <= most)[:, None], holds, most[:, None] * against)


def _direction(vectors: Array) -> Array:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(size, np.finfo(float).tiny)
