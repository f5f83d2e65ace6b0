"""Points that bodies carry, whose motion combines displacement and rotation in one vector."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism

_LEAST_ARM = 1e-3  # share of a body's reach; points nearer to its centre drown in rounding
_ARMS = np.concatenate([np.zeros((1, 3)), np.eye(3)])


@dataclass(frozen=True, eq=False)
class CarriedPoints:
    """Four points per body: its centre of mass, and one at the radius of gyration along each axis
    of its native frame.
    """

    mechanism: Mechanism

    def rms(self, vectors: Array) -> Array:
        """Return the RMS over mass and points, shape (trajectory, step)."""
        return np.sqrt(self.inner(vectors, vectors))

    def each(self, vectors: Array) -> Array:
        """Return the RMS over each body's points, moved out to the body's ends, shape (…, body).

        Vectors relative to the centre grow in proportion to the distance from it.
        """
        center = vectors[..., :1, :]
        stretch = _extents(self.mechanism) / _gyrations(self.mechanism)
        ends = center + stretch[:, None, None] * (vectors - center)
        return np.sqrt(np.einsum("...bpi,...bpi->...b", ends, ends) / len(_ARMS))

    def as_bodies(self, points: Array, native: Array) -> tuple[Array, Array]:
        """Compute velocities [m/s], [rad/s] of bodies from those of points, (…, body, 3)."""
        axes = rotation.rotate(native[..., None, :], _ARMS[1:])
        turns = rotation.cross(axes, points[..., 1:, :] - points[..., :1, :]).sum(axis=-2)
        return points[..., 0, :], turns / (2.0 * _gyrations(self.mechanism)[:, None])

    def as_points(self, velocity: Array, spin: Array, native: Array) -> Array:
        """Compute velocities of points from those of bodies [m/s], shape (…, body, point, 3)."""
        arm = rotation.rotate(
            native[..., None, :], _gyrations(self.mechanism)[:, None, None] * _ARMS
        )
        return velocity[..., None, :] + rotation.cross(spin[..., None, :], arm)

    def inner(self, one: Array, other: Array) -> Array:
        """Return the scalar product averaged over mass and points, shape (trajectory, step)."""
        share = self.mechanism.mass / (4.0 * self.mechanism.mass.sum())
        weighed = share[:, None, None] * one  # einsum of three takes several times as long
        return np.asarray(np.einsum("...bpi,...bpi->...", weighed, other))


def carried(
    mechanism: Mechanism, states: BodyStates, pull: Array, push: Array
) -> tuple[Array, Array, Array]:
    """Compute positions, velocities and accelerations of the points that the bodies carry."""
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
    """Return mean radii of gyration [m], shape (body,), at least a thousandth of bodies' reaches.

    A link without moments of inertia turns, too, so its points must not coincide.
    """
    radii = np.sqrt(np.trace(mechanism.inertia, axis1=1, axis2=2) / (2 * mechanism.mass))
    return np.maximum(radii, _LEAST_ARM * _reaches(mechanism))


@functools.lru_cache(maxsize=64)
def _extents(mechanism: Mechanism) -> Array:
    """Return distances of the farthest things that bodies carry from their centres [m], (body,).

    They are at least the radius of gyration. A slender rod that twists hardly moves its mass, but
    does move a joint on its side.
    """
    return np.maximum(_gyrations(mechanism), _reaches(mechanism))


def _reaches(mechanism: Mechanism) -> Array:
    """Return how far joints, particles, spheres and attachments reach from centres of mass [m]."""
    joints = [((one.parent, one.child), (one.in_parent, one.in_child)) for one in mechanism.joints]
    pairs = [(pair.bodies, pair.in_body) for pair in (*mechanism.distances, *mechanism.springs)]
    ends = [
        (body, float(np.linalg.norm(point)))
        for bodies, points in (*joints, *pairs)
        for body, point in zip(bodies, points, strict=True)
        if body != WORLD_INDEX
    ]
    particles = np.linalg.norm(mechanism.particle_offset, axis=1)
    spheres = np.linalg.norm(mechanism.sphere_offset, axis=1) + mechanism.sphere_radius
    reaches = np.zeros(len(mechanism.mass))
    for body, distance in (
        *ends,
        *zip(mechanism.particle_body, particles, strict=True),
        *zip(mechanism.sphere_body, spheres, strict=True),
    ):
        reaches[body] = max(reaches[body], distance)
    return reaches
