"""Is the trajectory a trajectory: finite numbers, unit quaternions, the start that was drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.checks.finding import Finding, Record

__all__ = ["finite", "planarity", "start"]

Array = NDArray[np.float64]

_UNIT = 1e-9
_SAME_START = 1e-12


def finite(record: Record) -> Finding:
    """Find numbers that are not finite (figure ∞) and quaternions that are not unit."""
    length = rotation.norm(record.trajectory.orientation)
    off = np.where(record.finite[:, :, None], np.abs(length - 1.0), np.inf)
    reasons = [failure.reason for failure in record.trajectory.failures if failure is not None]
    return Finding.of(
        "finite", "1", off, budget=_UNIT, names=_body_names(record), note="; ".join(reasons[:3])
    )


def start(record: Record) -> Finding:
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
    return Finding.of("start", "1", parts, budget=_SAME_START, names=_body_names(record))


def planarity(record: Record) -> Finding | None:
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
    return Finding.of(
        "planarity",
        "1",
        off,
        budget=scene.budget.planarity,
        names=tuple(names[body] for body in owners),
    )


def _relative(got: Array, drawn: Array, floor: float | Array) -> Array:
    scale = np.maximum(floor, np.abs(drawn).max(axis=(1, 2)))
    return np.abs(got - drawn).max(axis=2) / scale[:, None]


def _body_names(record: Record) -> tuple[str, ...]:
    return tuple(body.name for body in record.scene.bodies)
