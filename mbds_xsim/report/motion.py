"""Drawing of a moving scene: points, lines and view, and motions packed for the viewer.

All motions share one *base* (the reference, or the first engine without one), in 16 bits over its
bounding box. Each engine is its deviation from the base, in 16 bits on a cubic scale: a deviation
of a micrometre keeps two digits next to one of a metre, so that the viewer can magnify it.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.report.themed import Style
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory

Edge = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Points and lines to draw; moving points are numbered first, then fixed ones."""

    mechanism: Mechanism
    body: Index
    """Body of each moving point, shape (point,)."""
    offset: Array
    """Offset of each point in the native frame of its body [m], shape (point, 3)."""
    radius: Array
    """True radius of a contact sphere, 0 for a dot, −1 for a bare end of a line [m]; (point,)."""
    fixed: Array
    """Fixed points in W [m], shape (fixed point, 3)."""
    edges: tuple[Edge, ...]

    def positions(self, motion: Trajectory) -> Array:
        """Return the moving points in W [m], shape (trajectory, frame, point, 3)."""
        return BodyStates.of(self.mechanism, motion).points(self.body, self.offset)


def skeleton(scene: Scene) -> Skeleton:
    """Make a skeleton of a scene's particles, anchors and edges.

    A body without particles shows its centre of mass. A scene without edges gets lines from the
    centres of its bodies to their joints, and along its distance links and springs.
    """
    mechanism, points = Mechanism.of(scene), _Nodes()
    for body, offset in zip(mechanism.particle_body, mechanism.particle_offset, strict=True):
        points.add(int(body), offset)
    for anchor in scene.anchors:
        points.add(WORLD_INDEX, np.array(anchor))
    centres = {
        body: points.add(body, np.zeros(3))
        for body, count in enumerate(mechanism.particles_per_body)
        if count == 0
    }
    lines = scene.edges or list(_mechanical_edges(mechanism, points, centres))
    for body, offset, radius in zip(
        mechanism.sphere_body, mechanism.sphere_offset, mechanism.sphere_radius, strict=True
    ):
        points.add(int(body), offset, float(radius))
    body = np.array([body for body, _, _ in points], dtype=np.int64)
    offset = np.array([offset for _, offset, _ in points]).reshape(-1, 3)
    radius = np.array([radius for _, _, radius in points])
    moving = body != WORLD_INDEX
    number = np.empty(len(body), dtype=np.int64)
    number[np.argsort(~moving, kind="stable")] = np.arange(len(body))
    edges = tuple((int(number[a]), int(number[b])) for a, b in lines)
    return Skeleton(mechanism, body[moving], offset[moving], radius[moving], offset[~moving], edges)


class _Nodes(list[tuple[int, Array, float]]):
    """Points of a skeleton under construction: body, offset and radius."""

    def add(self, body: int, offset: Array, radius: float = 0.0) -> int:
        self.append((body, offset, radius))
        return len(self) - 1


def _mechanical_edges(
    mechanism: Mechanism, points: _Nodes, centres: dict[int, int]
) -> Iterator[Edge]:
    bare_end = -1.0
    for joint in mechanism.joints:
        end = points.add(joint.child, joint.in_child, bare_end)
        for body in (joint.parent, joint.child):
            if body != WORLD_INDEX:
                if body not in centres:
                    centres[body] = points.add(body, np.zeros(3), bare_end)
                yield centres[body], end
    for pair in (*mechanism.distances, *mechanism.springs):
        one, other = map(points.add, pair.bodies, pair.in_body, (bare_end, bare_end))
        yield one, other


@dataclass(frozen=True, eq=False)
class Projection:
    """View direction: the rows of `axes` point right, up and towards the viewer."""

    axes: Array

    @staticmethod
    def of(points: Array, dimension: int) -> Projection:
        """Look along a coordinate in which the points do not differ, y first; else obliquely."""
        spread = np.ptp(points, axis=0)
        flat = spread <= 1e-6 * max(float(spread.max()), 1e-12)
        x, y, z = np.eye(3)
        if dimension < 3 or flat[1]:
            return Projection(np.array([x, z, -y]))
        if flat[0]:
            return Projection(np.array([y, z, x]))
        if flat[2]:
            return Projection(np.array([x, y, z]))
        azimuth, elevation = math.radians(-62.0), math.radians(22.0)
        ahead = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        towards = math.cos(elevation) * ahead + math.sin(elevation) * z
        right = np.array([-ahead[1], ahead[0], 0.0])
        return Projection(np.array([right, np.cross(towards, right), towards]))

    def flat(self, points: Array) -> Array:
        """Project points or directions (…, 3) onto the picture (…, 2)."""
        return points @ self.axes[:2].T

    def depth(self, points: Array) -> Array:
        """Return how near points or directions (…, 3) are to the viewer."""
        return points @ self.axes[2]


def pose_of(mechanism: Mechanism, start: int | None) -> BodyStates:
    """Return the reference pose, at rest, or the start of a trajectory."""
    if start is None:
        return BodyStates.at_reference(mechanism)
    return BodyStates.of(mechanism, draw_batch(mechanism.scene, [start]))[0]


def outline(mechanism: Mechanism, pose: BodyStates, view: Projection, body: int) -> Array:
    """Return M of the outline pᵀ M⁻¹ p = 1 of the ellipsoid with a body's mass and inertia, (2, 2).

    The ellipsoid is homogeneous: its semi-axes a, b, c obey I₁ = m (b² + c²) / 5 and so on.
    """
    turn = view.axes @ rotation.matrix(pose.native[body])
    tensor = mechanism.inertia[body]
    squares = 2.5 / mechanism.mass[body] * (np.trace(tensor) * np.eye(3) - 2.0 * tensor)
    return np.asarray((turn @ squares @ turn.T)[:2, :2])


_REACH = 4.0
"""Distance from the common motion at which a point is out of view, over that motion's extent."""


def packed(
    motions: Iterable[tuple[str, Style | None, Array, Array | None]],
    base: Array,
    length: float,
    step: float,
) -> dict[str, Any]:
    """Pack motions as deviations from a common motion, which is packed over its bounding box.

    Args:
        motions: Name, style (None for the common motion), points [m], shape (trajectory, frame,
            point, 3), NaN from where it ends, and RMS error [m], shape (trajectory, frame), if any.
        base: Common motion, of the same shape.
        length: Length of the scene [m], used if the motion's extent is smaller.
        step: Time between frames [s].
    """
    low, high = base.min(axis=(0, 1, 2)), base.max(axis=(0, 1, 2))
    reach = _REACH * max(float(np.linalg.norm(high - low)), length)
    return {
        "frames": base.shape[1],
        "step": step,
        "low": low.tolist(),
        "high": high.tolist(),
        "base": encoded(65535 * (base - low) / np.where(high > low, high - low, 1.0), "<u2"),
        "reach": reach,
        "entries": [
            _entry(name, style, motion - base, reach)
            | {"error": None if error is None else encoded(error, "<f4")}
            for name, style, motion, error in motions
        ],
    }


def _entry(name: str, style: Style | None, deviation: Array, reach: float) -> dict[str, Any]:
    with np.errstate(invalid="ignore"):
        visible = (np.abs(deviation) <= reach).all(axis=(-1, -2))
    shown = np.logical_and.accumulate(visible, axis=1)
    scaled = np.cbrt(np.where(shown[..., None, None], deviation, 0.0) / reach)
    return {
        "name": name,
        "colour": None if style is None else style.colour,
        "dashed": style is not None and style.dashed,
        "shown": shown.sum(axis=1).tolist(),
        "deviation": None if style is None else encoded(32767 * scaled, "<i2"),
    }


def encoded(values: Array, kind: str) -> str:
    """Encode numbers as base64, rounded if the kind is one of integers."""
    return in_base64((values if kind.endswith("f4") else np.rint(values)).astype(kind))


def in_base64(values: NDArray[Any]) -> str:
    """Encode the bytes of numbers, unchanged, as base64."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
