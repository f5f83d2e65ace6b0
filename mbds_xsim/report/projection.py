"""Looking at a scene: a pose, and the plane it is projected on orthographically."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.sampling import draw_batch

__all__ = ["View", "outline", "point_of", "pose_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """Where one looks from: rows are right, up and towards the viewer."""

    axes: Array

    @staticmethod
    def of(points: Array, dimension: int) -> View:
        """Look along a coordinate in which the points do not differ, y first; else obliquely."""
        spread = np.ptp(points, axis=0)
        flat = spread <= 1e-6 * max(float(spread.max()), 1e-12)
        x, y, z = np.eye(3)
        if dimension < 3 or flat[1]:
            return View(np.array([x, z, -y]))
        if flat[0]:
            return View(np.array([y, z, x]))
        if flat[2]:
            return View(np.array([x, y, z]))
        azimuth, elevation = math.radians(-62.0), math.radians(22.0)
        towards = np.array(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        return View(np.array([right, np.cross(towards, right), towards]))

    def flat(self, points: Array) -> Array:
        """Project points or directions (…, 3) onto the picture (…, 2)."""
        return points @ self.axes[:2].T

    def depth(self, points: Array) -> Array:
        """Nearness to the viewer."""
        return points @ self.axes[2]


def pose_of(mechanism: Mechanism, start: int | None) -> BodyStates:
    """Pose of the reference, or of the start of a trajectory; nothing moves in a picture."""
    if start is None:
        native = np.tile(rotation.IDENTITY, (mechanism.body_count, 1))
        position = mechanism.com
    else:
        batch = draw_batch(mechanism.scene, [start])
        position, native = batch.position[0], mechanism.native_rotation(batch.orientation)[0]
    still = np.zeros_like(position)
    return BodyStates(position, native, still, still)


def point_of(pose: BodyStates, body: int, offset: Array) -> Array:
    """A point fixed in a body (or the world), in W [m]."""
    if body == WORLD_INDEX:
        return offset
    return pose.position[body] + rotation.rotate(pose.native[body], offset)


def outline(mechanism: Mechanism, pose: BodyStates, view: View, body: int) -> Array:
    """Outline of the homogeneous ellipsoid with a body's mass and inertia: pᵀ M⁻¹ p = 1, (2, 2).

    Its semi-axes a, b, c obey I₁ = m (b² + c²) / 5 and so on.
    """
    turn = view.axes @ rotation.matrix(pose.native[body])
    tensor = mechanism.inertia[body]
    squares = 2.5 / mechanism.mass[body] * (np.trace(tensor) * np.eye(3) - 2.0 * tensor)
    return np.asarray((turn @ squares @ turn.T)[:2, :2])
