"""Points that bodies carry, by which displacements and turns of bodies are one kind of vector."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism

_LEAST_ARM = 1e-3  # of what a body carries: places of points nearer to its centre are rounding
_ARMS = np.concatenate([np.zeros((1, 3)), np.eye(3)])


@dataclass(frozen=True, eq=False)
class CarriedPoints:
    """Four points a body: its centre of mass and, along each axis of its native frame, a point at
    its radius of gyration.
    """

    mechanism: Mechanism

    def rms(self, vectors: Array) -> Array:
        """RMS over mass and points, shape (trajectory, step)."""
        return np.sqrt(self.inner(vectors, vectors))

    def each(self, vectors: Array) -> Array:
        """RMS over points of each body at its ends, not the radius of gyration, [..., body].

        What points move moves with the distance from the centre.
        """
        center = vectors[..., :1, :]
        stretch = _extents(self.mechanism) / _gyrations(self.mechanism)
        ends = center + stretch[:, None, None] * (vectors - center)
        return np.sqrt(np.einsum("...bpi,...bpi->...b", ends, ends) / len(_ARMS))

    def as_bodies(self, points: Array, native: Array) -> tuple[Array, Array]:
        """Velocities of bodies [m/s] and [rad/s] of those of their points, (…, body, 3)."""
        axes = rotation.rotate(native[..., None, :], _ARMS[1:])
        turns = rotation.cross(axes, points[..., 1:, :] - points[..., :1, :]).sum(axis=-2)
        return points[..., 0, :], turns / (2.0 * _gyrations(self.mechanism)[:, None])

    def as_points(self, velocity: Array, spin: Array, native: Array) -> Array:
        """Give the reverse, (…, body, point, 3)."""
        arm = rotation.rotate(
            native[..., None, :], _gyrations(self.mechanism)[:, None, None] * _ARMS
        )
        return velocity[..., None, :] + rotation.cross(spin[..., None, :], arm)

    def inner(self, one: Array, other: Array) -> Array:
        """Scalar product averaged over mass and points, shape (trajectory, step)."""
        share = self.mechanism.mass / (4.0 * self.mechanism.mass.sum())
        weighed = share[:, None, None] * one  # einsum of three takes several times as long
        return np.asarray(np.einsum("...bpi,...bpi->...", weighed, other))


def carried(
    mechanism: Mechanism, states: BodyStates, pull: Array, push: Array
) -> tuple[Array, Array, Array]:
    """Positions, velocities and accelerations of the points that the bodies carry."""
    turn, spin = states.native[..., None, :], states.angular_velocity[..., None, :]
    arm = rotation.rotate(turn, _gyrations(mechanism)[:, None, None] * _ARMS)
    swing = rotation.cross(spin, arm)
    return (
        states.position[..., None, :] + arm,
        states.velocity[..., None, :] + swing,
        pull[..., None, :] + rotation.cross(push[..., None, :], arm) + rotation.cross(spin, swing),
    )


@functools.lru_cache(maxsize=64)
def _gyrations(mechanism: Mechanism) -> Array:
    """Mean radii of gyration [m], shape (body,), where points of moving bodies can be told apart.

    A link of no moments of inertia turns like any other, by what it hangs on.
    """
    own = np.sqrt(np.trace(mechanism.inertia, axis1=1, axis2=2) / (2 * mechanism.mass))
    return np.maximum(own, _LEAST_ARM * _reaches(mechanism))


@functools.lru_cache(maxsize=64)
def _extents(mechanism: Mechanism) -> Array:
    """From centres of mass to the furthest of what bodies carry [m], shape (body,).

    That, or the radius of gyration: a slender rod that twists moves hardly any of its mass, but a
    joint on its side.
    """
    return np.maximum(_gyrations(mechanism), _reaches(mechanism))


def _reaches(mechanism: Mechanism) -> Array:
    """From centres of mass to joints, particles, contact spheres and attachment points [m]."""
    joints = [((one.parent, one.child), (one.in_parent, one.in_child)) for one in mechanism.joints]
    pairs = [(pair.bodies, pair.in_body) for pair in (*mechanism.distances, *mechanism.springs)]
    carried = [
        (body, float(np.linalg.norm(point)))
        for bodies, points in (*joints, *pairs)
        for body, point in zip(bodies, points, strict=True)
        if body != WORLD_INDEX
    ]
    particles = np.linalg.norm(mechanism.particle_offset, axis=1)
    spheres = np.linalg.norm(mechanism.sphere_offset, axis=1) + mechanism.sphere_radius
    found = np.zeros(len(mechanism.mass))
    for body, distance in (
        *carried,
        *zip(mechanism.particle_body, particles, strict=True),
        *zip(mechanism.sphere_body, spheres, strict=True),
    ):
        found[body] = max(found[body], distance)
    return found
