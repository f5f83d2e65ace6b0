"""Contact spheres over the ground and beside each other: how far, how fast, and how they slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
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


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Pairs of contact spheres that may touch each other, each array of shape (…, pair)."""

    gap: Array
    """Between the spheres [m]."""
    climb: Array
    """Rate of the gap [m/s]."""
    slip: Array
    """Velocity of the one's point of contact past the other's [m/s], shape (…, pair, 3)."""
    normal: Array
    """From the other sphere's centre to the one's, unit, shape (…, pair, 3)."""
    speed: Array
    """Of the centres beside each other [m/s], shape (…, pair)."""

    def __getitem__(self, picks: Any) -> Neighbours:
        """Take some, by the first axes."""
        return Neighbours(**{key: values[picks] for key, values in vars(self).items()})


def neighbours_of(mechanism: Mechanism, bodies: BodyStates) -> Neighbours:
    """Compute gaps, their rates and slips of all pairs of spheres, from states (…, body, …)."""
    carrier, radius = mechanism.sphere_body, mechanism.sphere_radius
    place = bodies.points(carrier, mechanism.sphere_offset)
    speed = bodies.speeds(carrier, mechanism.sphere_offset)
    one, other = mechanism.sphere_pairs.T
    apart, parting = (part[..., one, :] - part[..., other, :] for part in (place, speed))
    distance = rotation.norm(apart)
    normal = apart / distance[..., None]
    climb = rotation.dot(parting, normal)
    spin = bodies.angular_velocity[..., carrier, :] * radius[:, None]
    turning = rotation.cross(spin[..., one, :] + spin[..., other, :], normal)
    slip = parting - climb[..., None] * normal - turning
    gap = distance - radius[one] - radius[other]
    return Neighbours(gap, climb, slip, normal, rotation.norm(parting))


def spheres_of(mechanism: Mechanism, bodies: BodyStates) -> Spheres:
    """Compute gaps, their rates and slips of all contact spheres, from states (…, body, …)."""
    carrier = mechanism.sphere_body
    arm = bodies.arms(carrier, mechanism.sphere_offset)
    gap = bodies.position[..., carrier, 2] + arm[..., 2] - mechanism.sphere_radius
    down = mechanism.sphere_radius[:, None] * np.array([0.0, 0.0, -1.0])
    swing = rotation.cross(bodies.angular_velocity[..., carrier, :], arm + down)
    speed = bodies.velocity[..., carrier, :] + swing
    return Spheres(gap, speed[..., 2], speed[..., :2])


def driven(mechanism: Mechanism, bodies: BodyStates, pull: float) -> Array:
    """Give what gravity and the bodies' rotation add to the spheres' speeds [m/s²], (…, sphere)."""
    spin = bodies.angular_velocity[..., mechanism.sphere_body, :]
    reach = np.linalg.norm(mechanism.sphere_offset, axis=-1)
    return np.asarray(pull + np.sum(spin**2, axis=-1) * reach)


def out_of_reach(gap: Array, speed: Array, pull: Array, frame: float) -> Mask:
    """Tell in which steps a gap cannot close at the speeds and pulls of both ends, (…, step, gap).

    Args:
        gap: At frames [m], shape (trajectory, frame, gap).
        speed: At which it may close [m/s].
        pull: What may add to the speed [m/s²].
        frame: Interval between frames [s].
    """
    far = gap > frame * (speed + frame * pull)
    return np.asarray(far[:, 1:] & far[:, :-1])
