"""The axes of Bullet's friction, and where to turn them so that friction opposes the slip.

Bullet has a friction row along each of two axes, x and y of the world. In every sweep a row adds to
its impulse what would stop the slip along its axis alone, −v/w, with w its diagonal element of
W = J M⁻¹ Jᵀ, and both are then cut to the cone together. A slip that lasts therefore ends with
impulses in proportion to v/w, whatever the step and the number of sweeps: where a body yields more
along one axis than along the other, as a wheel does along its heading, friction is aside of the
slip, by up to 45°. Along axes at 45° to the principal ones of W both w are alike, and it is not.

Axes other than x and y come of Bullet's anisotropic friction, by which factors in a body's own
frame stretch them. Factors of 1 and −1 on the ground reflect them, and the ground, which looks
alike from all sides, is turned by half the angle.

resolveConeFrictionConstraintRows and convertMultiBodyContact of btMultiBodyConstraintSolver,
https://github.com/bulletphysics/bullet3
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism, PlacedJoint

__all__ = ["REFLECTION", "Yielding"]

Array = NDArray[np.float64]

REFLECTION = (1.0, -1.0, 1.0)
"""Factors of anisotropic friction that reflect the axes of friction at the ground's own x axis."""
_RATES = {"ball": 3, "hinge": 1, "slider": 1, "fixed": 0}


class Yielding:
    """How bodies yield to pushes of the ground: mass matrices of the spanning tree.

    What closes loops is left out.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        sizes = [_RATES[link.joint.kind] if link.joint else 6 for link in mechanism.links]
        ends = np.cumsum(sizes)
        self._count = int(ends[-1])
        self._plan = [
            (link.body, link.parent, link.joint, slice(end - size, end))
            for link, size, end in zip(mechanism.links, sizes, ends.tolist(), strict=True)
        ]
        moments, axes = np.linalg.eigh(mechanism.inertia)
        self._inertia_root = np.sqrt(moments)[..., None] * np.swapaxes(axes, -1, -2)
        self._mass_root = np.sqrt(mechanism.mass)[:, None, None]

    def alike(self, bodies: BodyStates, spheres: NDArray[np.int64]) -> Array:
        """Find the horizontal axes along which bodies yield alike.

        Args:
            bodies: A state of all bodies, shape (body, …).
            spheres: Those that touch.

        Returns:
            Angle of one axis from x, the other is across [rad], shape (sphere,).
        """
        xx, xy, yy = self._horizontal(bodies, spheres)
        return np.asarray(0.5 * np.arctan2(2.0 * xy, xx - yy) + np.pi / 4)

    def _horizontal(self, bodies: BodyStates, spheres: NDArray[np.int64]) -> Array:
        """Elements xx, xy and yy of W at the spheres' lowest points [1/kg], shape (3, sphere)."""
        mechanism, turn = self._mechanism, rotation.matrix(bodies.native)
        twist = self._twists(bodies, turn)
        scaled = np.concatenate(
            [
                self._mass_root * twist[:, :3],
                self._inertia_root @ np.swapaxes(turn, -1, -2) @ twist[:, 3:],
            ],
            axis=1,
        ).reshape(-1, self._count)
        body = mechanism.sphere_body[spheres]
        arm = np.einsum("sij,sj->si", turn[body], mechanism.sphere_offset[spheres])
        arm[:, 2] -= mechanism.sphere_radius[spheres]
        slip = twist[body, :2] - (_cross_matrix(arm) @ twist[body, 3:])[:, :2]
        x, y = slip[:, 0], slip[:, 1]
        given = np.linalg.solve(scaled.T @ scaled, np.concatenate([x, y]).T).T
        for_x, for_y = given[: len(x)], given[len(x) :]
        return np.stack([np.vecdot(x, for_x), np.vecdot(x, for_y), np.vecdot(y, for_y)])

    def _twists(self, bodies: BodyStates, turn: Array) -> Array:
        """Velocity and angular velocity by the tree's rates, shape (body, 6, rate)."""
        twist = np.zeros((len(turn), 6, self._count))
        for body, parent, joint, own in self._plan:
            if joint is None:
                twist[body, :, own] = np.eye(6)
                continue
            above = np.eye(3)
            if parent != WORLD_INDEX:
                above, apart = turn[parent], bodies.position[body] - bodies.position[parent]
                twist[body] = twist[parent]
                twist[body, :3] -= _cross_matrix(apart) @ twist[parent, 3:]
            twist[body, :, own] += _rates(joint, above, -turn[body] @ joint.in_child)
        return twist


def _rates(joint: PlacedJoint, above: Array, arm: Array) -> Array:
    """Twist of a link by its own rates, (6, rate); the arm is from the joint to its centre."""
    if joint.kind == "fixed":
        return np.zeros((6, 0))
    if joint.kind == "ball":
        return np.concatenate([-_cross_matrix(arm), np.eye(3)])
    axis = (above @ joint.axis)[:, None]
    if joint.kind == "slider":
        return np.concatenate([axis, np.zeros((3, 1))])
    return np.concatenate([-_cross_matrix(arm) @ axis, axis])


def _cross_matrix(v: Array) -> Array:
    """The matrix of v ×, shape (…, 3, 3)."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = v
    matrix[..., [1, 2, 0], [2, 0, 1]] = -v
    return matrix
