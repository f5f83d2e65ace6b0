"""The points of a scene whose motion is published, from the bodies' motion and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.markers import markers
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.sampling import noise_components
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory

_BODY_FRAMES = 20_000  # worked on at once: their arrays stay in a core's cache


@dataclass(frozen=True, eq=False)
class Points:
    """Particles, and stand-ins in bodies without any."""

    mechanism: Mechanism
    body: Index
    """Body of each point, shape (point,)."""
    offset: Array
    """From its centre of mass in the native frame [m], shape (point, 3)."""
    axes: list[int]
    """Components of W in which the scene moves."""

    @staticmethod
    def of(scene: Scene) -> Points:
        """Find the points of a scene."""
        mechanism = Mechanism.of(scene)
        return Points(mechanism, *markers(mechanism), noise_components(scene))

    def motion(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """Positions [m] and velocities [m/s], each of shape (trajectory, frame, point, axis)."""
        count, frames, bodies = trajectory.position.shape[:3]
        shape = (count, frames, len(self.body), len(self.axes))
        position, velocity = np.empty(shape), np.empty(shape)
        size = max(1, _BODY_FRAMES // (frames * bodies))
        for first in range(0, count, size):
            rows = slice(first, first + size)
            position[rows], velocity[rows] = self._moved(trajectory[rows])
        return position, velocity

    def _moved(self, trajectory: Trajectory) -> tuple[Array, Array]:
        # So laid out in memory, components are apart, and numpy is several times faster.
        states = BodyStates.of(self.mechanism, trajectory).each(np.asfortranarray)
        arm = states.arms(self.body, self.offset)
        swing = rotation.cross(states.angular_velocity[..., self.body, :], arm)
        position = states.position[..., self.body, :] + arm
        velocity = states.velocity[..., self.body, :] + swing
        if len(self.axes) == 3:
            return position, velocity
        return position[..., self.axes], velocity[..., self.axes]

    def lifted(self, values: NDArray[Any], rest: Array | float = 0.0) -> Array:
        """Give three components; those that the scene does not move in are at rest."""
        whole = np.broadcast_to(rest, (*values.shape[:-1], 3)).copy()
        whole[..., self.axes] = values
        return whole

    def graph(self) -> dict[str, NDArray[Any]]:
        """Nodes and edges; static nodes are numbered after the points."""
        scene = self.mechanism.scene
        edges = np.array(scene.edges, dtype=np.int64).reshape(-1, 2)
        shift = len(self.body) - scene.particle_count
        static = np.array(scene.anchors, dtype=np.float64).reshape(-1, 3)
        return {
            "graph/edge": np.where(edges >= scene.particle_count, edges + shift, edges),
            "graph/point_body": self.body,
            "graph/static_node": static[:, self.axes],
            "graph/body_name": np.array([body.name for body in scene.bodies]),
        }


def axis_sizes(scene: Scene) -> dict[str, int]:
    """Lengths of the axes of the layout that the scene decides."""
    points = Points.of(scene)
    return {
        "frame": scene.clock.steps + 1,
        "step": scene.clock.steps,
        "body": len(scene.bodies),
        "point": len(points.body),
        "axis": len(points.axes),
        "hinge": len(points.mechanism.hinges),
        "edge": len(scene.edges),
        "static": len(scene.anchors),
        "xyz": 3,
        "wxyz": 4,
        "two": 2,
    }


_COINCIDENT = 1e-9  # of the scene's length


@dataclass(frozen=True, eq=False)
class Recovered:
    """The rigid motion of every body that is nearest to the points."""

    position: Array
    """Of centres of mass [m], shape (trajectory, frame, body, 3)."""
    orientation: Array
    """Shape (trajectory, frame, body, 4)."""
    velocity: Array | None
    """[m/s]; None without velocities of the points."""
    angular_velocity: Array | None
    """[rad/s]."""
    residual: Array
    """Largest distance of a point of the body from where the rigid body has it [m], shape
    (trajectory, frame, body)."""
    undetermined: tuple[str, ...]
    """Bodies whose orientation, about a line at least, the points do not tell."""


def recover(scene: Scene, position: Array, velocity: Array | None) -> Recovered:
    """Fit rigid bodies to points by least squares (Kabsch), and twists to their velocities.

    Joints help: where one sits on a point of another body, or is fixed in W, that point is one
    of this body's, too. A scene that stays in its plane turns about y alone.

    Args:
        scene: What moves.
        position: Of the points [m], shape (trajectory, frame, point, axis).
        velocity: Of the points [m/s], the same shape; None: not known.
    """
    points = Points.of(scene)
    mechanism = points.mechanism
    place = points.lifted(position, mechanism.com[points.body] + points.offset)
    speed = None if velocity is None else points.lifted(velocity)
    fixed = np.zeros((0, 3)) if scene.dimension == 3 else np.array([[0.0, 1.0, 0.0]])
    fits = [_fit(_known(points, body), fixed, place, speed) for body in range(len(scene.bodies))]
    *arrays, determined = zip(*fits, strict=True)
    position, native, drift, rate, residual = (np.stack(each, axis=2) for each in arrays)
    return Recovered(
        position=position,
        orientation=mechanism.body_orientation(native),
        velocity=None if velocity is None else drift,
        angular_velocity=None if velocity is None else rate,
        residual=residual,
        undetermined=tuple(
            body.name for body, sure in zip(scene.bodies, determined, strict=True) if not sure
        ),
    )


_Known = tuple[Array, Index, Array]
"""Points whose place in a body is known, own ones and joints on another body's point: the offset
from its centre of mass in the native frame [m], shape (known, 3); the number of the point, −1 where
it is fixed in W; the place of those [m], shape (known, 3)."""


def _known(points: Points, body: int) -> _Known:
    """Find the points whose place in a body is known."""
    mechanism = points.mechanism
    own = np.flatnonzero(points.body == body)
    offset, source, place = list(points.offset[own]), own.tolist(), [np.zeros(3)] * len(own)
    for joint in mechanism.joints:
        if body not in (joint.parent, joint.child) or joint.kind == "slider":
            continue
        here, there = joint.in_child, joint.in_parent
        other = joint.parent
        if body == joint.parent:
            here, there, other = there, here, joint.child
        found = -1 if other == WORLD_INDEX else _point_at(points, mechanism, other, there)
        if found is not None:
            offset.append(here)
            source.append(found)
            place.append(there)
    return np.reshape(offset, (-1, 3)), np.array(source, dtype=int), np.reshape(place, (-1, 3))


def _point_at(points: Points, mechanism: Mechanism, body: int, offset: Array) -> int | None:
    near = np.linalg.norm(points.offset - offset, axis=1) <= _COINCIDENT * mechanism.scene.length
    found = np.flatnonzero(near & (points.body == body))
    return int(found[0]) if len(found) else None


def _fit(
    known: _Known, fixed: Array, place: Array, speed: Array | None
) -> tuple[Array, Array, Array, Array, Array, bool]:
    """Fit one body; directions that stay fixed in it and in W are like points at no distance.

    Returns:
        Position, turn of the native frame, velocity, angular velocity, and residual; whether the
        points determine them.
    """
    offset, source, held = known
    given = np.where((source < 0)[:, None], held, place[..., source, :])
    middle, centre = offset.mean(axis=0), given.mean(axis=-2)
    arms = offset - middle
    reach = float(np.sqrt((arms**2).sum(axis=1).max(initial=0.0)))
    still = fixed * max(reach, 1e-12)
    spread = np.linalg.svd(np.concatenate([arms, still]), compute_uv=False)
    determined = int((spread > 1e-6 * max(reach, 1e-12)).sum()) >= 2 and reach > 0
    inside = given - centre[..., None, :]
    turn = _nearest_turn(np.einsum("...ki,kj->...ij", inside, arms) + still.T @ still)
    native = rotation.from_matrix(turn)
    position = centre - rotation.rotate(native, middle)
    apart = given - position[..., None, :] - rotation.rotate(native[..., None, :], offset)
    residual = np.linalg.norm(apart, axis=-1).max(axis=-1)
    velocity = rate = np.zeros_like(position)
    if speed is not None:
        moved = np.where((source < 0)[:, None], 0.0, speed[..., source, :])
        rate = _twist(inside, still, moved - moved.mean(axis=-2, keepdims=True))
        velocity = moved.mean(axis=-2) + rotation.cross(rate, position - centre)
    return position, native, velocity, rate, residual, determined


def _nearest_turn(covariance: Array) -> Array:
    """Give the rotation matrices that match best, shape (…, 3, 3)."""
    left, _, right = np.linalg.svd(covariance)
    sign = np.ones((*covariance.shape[:-2], 3))
    sign[..., 2] = np.sign(np.linalg.det(left @ right))
    return np.asarray((left * sign[..., None, :]) @ right)


def _twist(inside: Array, still: Array, moved: Array) -> Array:
    """Give the angular velocities that match best [rad/s], shape (…, 3)."""
    arms = np.concatenate([inside, np.broadcast_to(still, (*inside.shape[:-2], *still.shape))], -2)
    square = np.einsum("...k,...k->...", arms, arms).sum(axis=-1)
    inertia = square[..., None, None] * np.eye(3) - np.einsum("...ki,...kj->...ij", arms, arms)
    momentum = rotation.cross(inside, moved).sum(axis=-2)
    return np.asarray(np.einsum("...ij,...j->...i", np.linalg.pinv(inertia), momentum))
