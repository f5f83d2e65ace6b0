"""Steps in which nothing can touch the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def flying(
    mechanism: Mechanism, bodies: BodyStates, frame: float, group: tuple[int, ...] | None = None
) -> Mask:
    """Find the steps in which no contact sphere of a group (or of all) can reach the ground.

    Shape (trajectory, step).
    """
    own = np.isin(mechanism.sphere_body, range(mechanism.body_count) if group is None else group)
    return np.asarray(clear(mechanism, bodies, frame)[:, :, own].all(axis=2))


def clear(mechanism: Mechanism, bodies: BodyStates, frame: float) -> Mask:
    """Tell in which steps each contact sphere cannot reach the ground.

    At both ends it must be higher than it would fall, at its own speed and at what gravity and the
    body's rotation add to it, in a whole frame. Shape (trajectory, step, sphere).
    """
    carrier = mechanism.sphere_body
    arm = rotation.rotate(bodies.native[:, :, carrier], mechanism.sphere_offset)
    height = bodies.position[:, :, carrier, 2] + arm[..., 2] - mechanism.sphere_radius
    spin = bodies.angular_velocity[:, :, carrier]
    speed = np.abs(bodies.velocity[:, :, carrier, 2] + np.cross(spin, arm)[..., 2])
    bend = np.sum(spin**2, axis=-1) * np.linalg.norm(mechanism.sphere_offset, axis=-1)
    pull = float(np.linalg.norm(mechanism.scene.gravity)) + bend
    high: Mask = height > frame * (speed + frame * pull)
    return high[:, 1:] & high[:, :-1]


def summed(values: Array, flights: Mask) -> Array:
    """Sum over the steps of each flight up to each step; NaN where there is none.

    Shape (trajectory, step, component), as the values.
    """
    total = np.cumsum(np.where(flights[..., None], values, 0.0), axis=1)
    steps = np.arange(1, values.shape[1] + 1)
    landed = np.maximum.accumulate(np.where(flights, 0, steps), axis=1)
    padded = np.concatenate([np.zeros_like(total[:, :1]), total], axis=1)
    before = np.take_along_axis(padded, landed[..., None], axis=1)
    return np.where(flights[..., None], total - before, np.nan)
