"""Contact spheres over the ground, and sums over the steps in which none can touch it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Spheres:
    """Contact spheres, each array of shape (…, sphere)."""

    gap: Array
    """Between the sphere and the ground [m]."""
    climb: Array
    """Rate of the gap [m/s]."""
    slip: Array
    """Horizontal velocity of the lowest point [m/s], shape (…, sphere, 2)."""

    def of(self, group: NDArray[np.int64]) -> Spheres:
        """Take some of the spheres."""
        return Spheres(self.gap[..., group], self.climb[..., group], self.slip[..., group, :])


def spheres_of(mechanism: Mechanism, bodies: BodyStates) -> Spheres:
    """Compute gaps, their rates and slips of all contact spheres, from states (…, body, …)."""
    carrier = mechanism.sphere_body
    arm = bodies.arms(carrier, mechanism.sphere_offset)
    gap = bodies.position[..., carrier, 2] + arm[..., 2] - mechanism.sphere_radius
    down = mechanism.sphere_radius[:, None] * np.array([0.0, 0.0, -1.0])
    swing = rotation.cross(bodies.angular_velocity[..., carrier, :], arm + down)
    speed = bodies.velocity[..., carrier, :] + swing
    return Spheres(gap, speed[..., 2], speed[..., :2])


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
