"""Points of a scene whose motion is published: computed from the bodies' motion, and back."""

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

_BODY_FRAMES = 20_000  # processed at once, so that their arrays stay in a core's cache


@dataclass(frozen=True, eq=False)
class Points:
    """Particles, and stand-in points in bodies without particles."""

    mechanism: Mechanism
    body: Index
    """Body of each point, shape (point,)."""
    offset: Array
    """Offset from the body's centre of mass in the native frame [m], shape (point, 3)."""
    axes: list[int]
    """Components of W in which the scene moves."""

    @staticmethod
    def of(scene: Scene) -> Points:
        """Find the points of a scene."""
        mechanism = Mechanism.of(scene)
        return Points(mechanism, *markers(mechanism), noise_components(scene))

    def motion(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s] of shape (trajectory, frame, point, axis)."""
        count, frames, bodies = trajectory.position.shape[:3]
        shape = (count, frames, len(self.body), len(self.axes))
        position, velocity = np.empty(shape), np.empty(shape)
        size = max(1, _BODY_FRAMES // (frames * bodies))
        for first in range(0, count, size):
            rows = slice(first, first + size)
            position[rows], velocity[rows] = self._moved(trajectory[rows])
        return position, velocity

    def _moved(self, trajectory: Trajectory) -> tuple[Array, Array]:
        # This memory layout keeps components apart, which makes numpy several times faster.
        states = BodyStates.of(self.mechanism, trajectory).each(np.asfortranarray)
        arm = states.arms(self.body, self.offset)
        swing = rotation.cross(states.angular_velocity[..., self.body, :], arm)
        position = states.position[..., self.body, :] + arm
        velocity = states.velocity[..., self.body, :] + swing
        if len(self.axes) == 3:
            return position, velocity
        return position[..., self.axes], velocity[..., self.axes]

    def lifted(self, values: NDArray[Any], rest: Array | float = 0.0) -> Array:
        """Return three components; those in which the scene does not move are those of `rest`."""
        whole = np.broadcast_to(rest, (*values.shape[:-1], 3)).copy()
        whole[..., self.axes] = values
        return whole

    def graph(self) -> dict[str, NDArray[Any]]:
        """Return nodes and edges; static nodes are numbered after the points."""
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
    """Return the lengths of the layout's axes that the scene decides."""
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


_COINCIDENT = 1e-9  # relative to the scene's length


@dataclass(frozen=True, eq=False)
class Recovered:
    """Rigid motion of every body that fits the points best."""

    position: Array
    """Positions of centres of mass [m], shape (trajectory, frame, body, 3)."""
    orientation: Array
    """Unit quaternions, shape (trajectory, frame, body, 4)."""
    velocity: Array | None
    """Velocities of centres of mass [m/s]; None without velocities of the points."""
    angular_velocity: Array | None
    """Angular velocities in W [rad/s]; None without velocities of the points."""
    residual: Array
    """Largest distance of a point of the body from its place in the rigid body [m], shape
    (trajectory, frame, body)."""
    undetermined: tuple[str, ...]
    """Bodies whose orientation the points do not determine, at least about one line."""


def recover(scene: Scene, position: Array, velocity: Array | None) -> Recovered:
    """Fit rigid bodies to points by least squares (Kabsch), and twists to their velocities.

    Joints help: a joint on a point of another body, or one that is fixed in W, counts as a point
    of this body, too. Bodies of a scene that stays in its plane rotate about y only.

    Args:
        scene: Scene that moves.
        position: Positions of the points [m], shape (trajectory, frame, point, axis).
        velocity: Velocities of the points [m/s], in the same shape; None if unknown.
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
from its centre of mass in the native frame [m], shape (known, 3); the number of the point, −1 if it
is fixed in W; the position in W of fixed points [m], shape (known, 3)."""


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
        point = -1 if other == WORLD_INDEX else _point_at(points, mechanism, other, there)
        if point is not None:
            offset.append(here)
            source.append(point)
            place.append(there)
    return np.reshape(offset, (-1, 3)), np.array(source, dtype=int), np.reshape(place, (-1, 3))


def _point_at(points: Points, mechanism: Mechanism, body: int, offset: Array) -> int | None:
    near = np.linalg.norm(points.offset - offset, axis=1) <= _COINCIDENT * mechanism.scene.length
    matches = np.flatnonzero(near & (points.body == body))
    return int(matches[0]) if len(matches) else None


def _fit(
    known: _Known, fixed: Array, place: Array, speed: Array | None
) -> tuple[Array, Array, Array, Array, Array, bool]:
    """Fit one body; `fixed` directions, the same in it and in W, count as further arms.

    Returns:
        Position, orientation of the native frame, velocity, angular velocity, residual, and whether
        the points determine them.
    """
    offset, source, anchors = known
    targets = np.where((source < 0)[:, None], anchors, place[..., source, :])
    middle, centre = offset.mean(axis=0), targets.mean(axis=-2)
    arms = offset - middle
    reach = float(np.sqrt((arms**2).sum(axis=1).max(initial=0.0)))
    still = fixed * max(reach, 1e-12)
    spread = np.linalg.svd(np.concatenate([arms, still]), compute_uv=False)
    determined = int((spread > 1e-6 * max(reach, 1e-12)).sum()) >= 2 and reach > 0
    inside = targets - centre[..., None, :]
    turn = _nearest_turn(np.einsum("...ki,kj->...ij", inside, arms) + still.T @ still)
    native = rotation.from_matrix(turn)
    position = centre - rotation.rotate(native, middle)
    misfit = targets - position[..., None, :] - rotation.rotate(native[..., None, :], offset)
    residual = np.linalg.norm(misfit, axis=-1).max(axis=-1)
    velocity = rate = np.zeros_like(position)
    if speed is not None:
        velocities = np.where((source < 0)[:, None], 0.0, speed[..., source, :])
        rate = _twist(inside, still, velocities - velocities.mean(axis=-2, keepdims=True))
        velocity = velocities.mean(axis=-2) + rotation.cross(rate, position - centre)
    return position, native, velocity, rate, residual, determined


def _nearest_turn(covariance: Array) -> Array:
    """Return the best-fitting rotation matrices (Kabsch), shape (…, 3, 3)."""
    left, _, right = np.linalg.svd(covariance)
    sign = np.ones((*covariance.shape[:-2], 3))
    sign[..., 2] = np.sign(np.linalg.det(left @ right))
    return np.asarray((left * sign[..., None, :]) @ right)


def _twist(inside: Array, still: Array, velocities: Array) -> Array:
    """Return the best-fitting angular velocities [rad/s], shape (…, 3)."""
    arms = np.concatenate([inside, np.broadcast_to(still, (*inside.shape[:-2], *still.shape))], -2)
    square = np.einsum("...k,...k->...", arms, arms).sum(axis=-1)
    inertia = square[..., None, None] * np.eye(3) - np.einsum("...ki,...kj->...ij", arms, arms)
    momentum = rotation.cross(inside, velocities).sum(axis=-2)
    return np.asarray(np.einsum("...ij,...j->...i", np.linalg.pinv(inertia), momentum))
