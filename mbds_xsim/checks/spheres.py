"""Contact spheres over the ground: how high, how fast, and how they slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Spheres:
    """Contact spheres over the ground, each array of shape (…, sphere)."""

    gap: Array
    """Between the sphere and the ground [m]."""
    climb: Array
    """Rate of the gap [m/s]."""
    slip: Array
    """Horizontal velocity of the lowest point [m/s], shape (…, sphere, 2)."""

    def of(self, group: Index) -> Spheres:
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
