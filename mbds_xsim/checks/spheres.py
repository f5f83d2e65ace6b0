"""Gaps, speeds and slips of contact spheres, over the ground and next to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask, Picked
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Spheres(Picked):
    """Contact spheres over the ground, each array of shape (…, sphere)."""

    gap: Array
    """Distance between the sphere and the ground [m]."""
    climb: Array
    """Rate of the gap [m/s]."""
    slip: Array
    """Horizontal velocity of the lowest point [m/s], shape (…, sphere, 2)."""


@dataclass(frozen=True, eq=False)
class Neighbours(Picked):
    """Pairs of contact spheres that may touch each other, each array of shape (…, pair)."""

    gap: Array
    """Distance between the surfaces of the spheres [m]."""
    climb: Array
    """Rate of the gap [m/s]."""
    slip: Array
    """Tangential velocity of the first contact point past the second [m/s], (…, pair, 3)."""
    normal: Array
    """Unit vector from the second sphere's centre to the first's, shape (…, pair, 3)."""
    speed: Array
    """Relative speed of the centres [m/s], shape (…, pair)."""


def neighbours_of(mechanism: Mechanism, bodies: BodyStates) -> Neighbours:
    """Compute gaps, their rates and slips of all pairs of spheres, from states (…, body, …)."""
    carrier, radius = mechanism.sphere_body, mechanism.sphere_radius
    place = bodies.points(carrier, mechanism.sphere_offset)
    speed = bodies.speeds(carrier, mechanism.sphere_offset)
    one, other = mechanism.sphere_pairs.T
    offset, parting = (part[..., one, :] - part[..., other, :] for part in (place, speed))
    distance = rotation.norm(offset)
    normal = offset / distance[..., None]
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


def direction(vectors: Array) -> Array:
    """Return unit vectors along vectors; zero stays zero."""
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, np.finfo(float).tiny))


def out_of_reach(gap: Array, speed: Array, pull: Array, frame: float) -> Mask:
    """Find steps in which gaps cannot close, by speeds and pulls at both ends, (…, step, gap).

    Args:
        gap: Distances at frames [m], shape (trajectory, frame, gap).
        speed: Largest closing speeds [m/s].
        pull: Largest accelerations that add to the speeds [m/s²].
        frame: Interval between frames [s].
    """
    far = gap > frame * (speed + frame * pull)
    return np.asarray(far[:, 1:] & far[:, :-1])
