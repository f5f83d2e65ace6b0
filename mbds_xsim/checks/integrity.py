"""Is the trajectory a trajectory: finite, unit quaternions, in double precision, as drawn."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.finding import Figures, Record, check

_UNIT = 1e-9
_SAME_START = 1e-12
_SINGLE = (1 << 29) - 1
"""Bits of a float64's significand that are 0 where a float32 has the same value."""
_ROUND = (1 << 37) - 1
"""The same of 16 significant bits: numbers such as 0.5 that are exact by nature."""
_FEW = 12
"""Numbers that may be float32 by chance, however many sets are made."""
_RESIDUE = 1e-6
"""Of the largest number: below 2⁻²⁸ a difference of large ones has no more bits than a float32."""
_MOST_SINGLE = 0.5
_STATE = ("position", "orientation", "velocity", "angular_velocity")


@check("finite", _UNIT)
def finite(record: Record) -> Figures:
    """Find numbers that are not finite (figure ∞) and quaternions that are not unit."""
    length = rotation.norm(record.trajectory.orientation)
    off = np.where(record.finite[:, :, None], np.abs(length - 1.0), np.inf)
    reasons = [failure.reason for failure in record.trajectory.failures if failure is not None]
    return Figures(off, _body_names(record), "; ".join(reasons[:3]))


@check("precision", _MOST_SINGLE)
def precision(record: Record) -> Figures:
    """Find states that were rounded to single precision: of 24 significant bits, not of 53.

    The figure is the share of float32 values among the numbers of a state array that move from
    frame to frame and are not short by nature. Counted are those that no sound computation leaves
    short: where the frame interval itself is a float32 number, as 1/64 s is, motion may be exact,
    so that orientations alone are looked at, and what starts with more bits.
    """
    found, batch = record.trajectory, record.batch
    exact = not _bits(np.array([record.frame]), _SINGLE).any()
    parts = np.zeros((len(batch), len(found.time), len(_STATE)))
    for k, name in enumerate(_STATE):
        values = getattr(found, name)
        single = ~_bits(values, _SINGLE) & _bits(values, _ROUND)
        single[:, 0] = False
        if not single.any():
            continue
        moving = np.zeros(values.shape, dtype=bool)
        moving[:, 1:] = (values[:, 1:] != values[:, :-1]) & _bits(values[:, 1:], _ROUND)
        floor = 1.0 if name in ("orientation", "angular_velocity") else record.scene.length
        large = np.nan_to_num(np.abs(values)).max(axis=(1, 2, 3), keepdims=True)
        moving &= np.abs(values) > _RESIDUE * np.maximum(large, floor)
        if exact and name != "orientation":
            moving &= _bits(getattr(batch, name), _SINGLE)[:, None]
        single &= moving
        count, short = moving.sum(axis=(1, 2, 3)), single.sum(axis=(1, 2, 3))
        first = single.any(axis=(2, 3)).argmax(axis=1)
        share = np.where(count >= _FEW, short / np.maximum(count, 1), 0.0)
        parts[np.arange(len(batch)), first, k] = share
    names = (f"{name.replace('_', ' ')} rounded to 24 significant bits" for name in _STATE)
    return Figures(parts, names)


@check("start", _SAME_START)
def start(record: Record) -> Figures:
    """Compare frame 0 with the drawn start, relative to the largest value of each kind.

    Velocities are also put together from rates at arms of up to the scene's length.
    """
    batch, motion = record.batch, record.trajectory
    spin = np.abs(batch.angular_velocity).max(axis=(1, 2)) * record.scene.length
    facing = np.sum(motion.orientation[:, 0] * batch.orientation, axis=-1, keepdims=True)
    near = np.where(facing < 0, -batch.orientation, batch.orientation)
    pairs = (
        (motion.position[:, 0], batch.position, record.scene.length),
        (motion.orientation[:, 0], near, 1.0),
        (motion.velocity[:, 0], batch.velocity, np.maximum(1.0, spin)),
        (motion.angular_velocity[:, 0], batch.angular_velocity, 1.0),
    )
    off = np.stack([_relative(got, drawn, floor) for got, drawn, floor in pairs])
    parts = np.full((len(batch), len(motion.time), batch.position.shape[1]), np.nan)
    parts[:, 0] = off.max(axis=0)
    return Figures(parts, _body_names(record))


@check("planarity", "planarity")
def planarity(record: Record) -> Figures | None:
    """Measure the excursion out of the scene's dimensions over its length; None in 3D.

    In 2D no particle or centre of mass leaves its plane. In 1D the centres of mass keep their
    height too, unless a contact carries them.
    """
    scene, mechanism, bodies = record.scene, record.mechanism, record.bodies
    if scene.dimension == 3:
        return None
    turned = mechanism.body_orientation(bodies.native)
    particles = mechanism.particle_positions(bodies.position, turned)[..., 1]
    aside = np.concatenate([bodies.position[..., 1], particles], axis=-1)
    owners = [*range(mechanism.body_count), *mechanism.particle_body]
    if scene.dimension == 1 and not scene.contacts:
        aside = np.concatenate([aside, bodies.position[..., 2]], axis=-1)
        owners += range(mechanism.body_count)
    off = np.abs(aside - aside[:, :1]) / scene.length
    names = _body_names(record)
    return Figures(off, [names[body] for body in owners])


def _bits(values: Array, mask: int) -> Mask:
    """Tell which numbers have any of some bits set; those that are not finite have none."""
    return np.asarray((np.ascontiguousarray(values).view(np.int64) & mask) != 0)


def _relative(got: Array, drawn: Array, floor: float | Array) -> Array:
    scale = np.maximum(floor, np.abs(drawn).max(axis=(1, 2)))
    return np.abs(got - drawn).max(axis=2) / scale[:, None]


def _body_names(record: Record) -> tuple[str, ...]:
    return tuple(body.name for body in record.scene.bodies)
