"""Conversion between bodies' states and MuJoCo's coordinates, and states from its kinematics.

Rods that never spin about themselves hang on Cardan joints in place of ball joints. Two hinges set
the direction of such a rod. The frames that they turn do spin about the rods, but without effect:
the model's rods have almost no inertia about themselves.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.joint_space import BodyStates, LinkStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.spin import idle_axes
from mbds_xsim.simulate.columns import LinkColumns, link_kinds, links_of

# Moment about a rod's axis over that across it, and its largest value that has no effect.
_SLIM, _STOUT = 1e-9, 1e-6
_LEAST_MOMENT = 2e-14  # [kg·m²]; MuJoCo's compiler requires more than 1e-14


class Coordinates:
    """Places of each link's coordinates in qpos and qvel.

    As in `LinkStates`, MuJoCo's ball joint turns child to parent and has its rate in the child's
    frame; its free joint has a velocity in W and a rate in the body's frame. Rods with an axis in
    `idle` hang on Cardan joints.
    """

    def __init__(self, model: Any, mechanism: Mechanism, idle: Array) -> None:
        kinds = [
            "cardan" if idle[link.body].any() else kind
            for link, kind in zip(mechanism.links, link_kinds(mechanism), strict=True)
        ]
        # MuJoCo numbers bodies depth first, links are breadth first: only names match.
        bodies = [model.body(mechanism.scene.bodies[link.body].name).id for link in mechanism.links]
        first = model.body_jntadr[bodies]
        places = model.jnt_qposadr, model.jnt_dofadr
        # Welded bodies have joint -1. It is not used, but without any joints it is no index.
        qpos, qvel = (place[first] if model.njnt else first for place in places)
        sizes, turning = (model.nq, model.nv), {"ball": 0, "free": 3}
        self._columns = LinkColumns(
            kinds, (qpos, qvel), sizes, turn=turning, spin=turning, shift=(0, 0)
        )
        self._cardan = links_of(kinds, "cardan")
        self._cross = _cross_axes(idle[[mechanism.links[k].body for k in self._cardan]])
        self._cardan_at = [at[self._cardan, None] + np.arange(2) for at in (qpos, qvel)]
        self.second = self._cardan_at[0][:, 1]
        """Places in qpos of the Cardan joints' second angles; the joints lock at a right angle."""

    def from_links(self, links: LinkStates) -> tuple[Array, Array]:
        """Return qpos (…, nq) and qvel (…, nv)."""
        qpos, qvel = self._columns.of_links(links)
        qpos[..., self._cardan_at[0]], qvel[..., self._cardan_at[1]] = _angles(
            links.rotation[..., self._cardan, :],
            links.angular_velocity[..., self._cardan, :],
            self._cross,
        )
        return qpos, qvel

    def to_links(self, qpos: Array, qvel: Array) -> LinkStates:
        """Convert coordinates (…, nq) and (…, nv) to links, with unit quaternions."""
        links = self._columns.to_links(qpos, qvel)
        turn, spin = links.rotation, links.angular_velocity
        turn[..., self._cardan, :], spin[..., self._cardan, :] = _rotations(
            qpos[..., self._cardan_at[0]], qvel[..., self._cardan_at[1]], self._cross
        )
        size = rotation.norm(turn)[..., None]
        np.divide(turn, size, out=turn, where=size > 0.0)
        return links


class Frames:
    """Recorded frames of trajectories, NaN at first.

    MuJoCo numbers bodies depth first, starting with W, and gives rates about the centre of mass of
    the tree that a body belongs to. Both are converted once, at the end.

    Args:
        model: The compiled model.
        data: Its state.
        bodies: MuJoCo's numbers of the scene's bodies.
        count: Number of trajectories.
        frames: Number of frames of each.
    """

    def __init__(self, model: Any, data: Any, bodies: Index, count: int, frames: int) -> None:
        self._model, self._data, self._bodies = model, data, bodies
        self._roots = model.body_rootid[bodies]
        self._live = (data.xipos[1:], data.xquat[1:], data.cvel[1:], data.subtree_com[1:])
        self._records = tuple(np.full((count, frames, *part.shape), np.nan) for part in self._live)

    def keep(self, row: int, frame: int, *, placed: bool = False) -> None:
        """Record the present state; `placed` says that its coordinates have placed the bodies."""
        model, data = self._model, self._data
        if not placed:
            mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        at = row, frame
        place, turn, twist, centre = self._records
        place[at], turn[at], twist[at], centre[at] = self._live

    def states(self) -> BodyStates:
        """Return the recorded states of the scene's bodies."""
        place, turn, twist, centre = self._records
        bodies, roots = self._bodies - 1, self._roots - 1
        position, rates = place[:, :, bodies], twist[:, :, bodies]
        spin = np.ascontiguousarray(rates[..., :3])
        velocity = rates[..., 3:] + rotation.cross(spin, position - centre[:, :, roots])
        return BodyStates(position, turn[:, :, bodies], velocity, spin)


def joint_name(name: str) -> str:
    """Return the name of a joint in the model; MuJoCo finds nothing by an empty one."""
    return name or "without a name"


def slim(inertia: Array, axis: Array) -> Array:
    """Return an inertia with almost nothing left about the axis."""
    across = np.eye(3) - np.outer(axis, axis)
    moment = _across(inertia, axis)
    return np.asarray(moment * (across + max(_SLIM, _LEAST_MOMENT / moment) * np.outer(axis, axis)))


def slim_axes(mechanism: Mechanism) -> Array:
    """Return the axes of rods that may be left without spin, zero for other bodies, (body, 3).

    The smallest rods keep it: next to what MuJoCo accepts about their axes they are not slim.
    """
    axes = idle_axes(mechanism.scene).copy()
    for axis, inertia in zip(axes, mechanism.inertia, strict=True):
        if axis.any() and _STOUT * _across(inertia, axis) < _LEAST_MOMENT:
            axis[:] = 0.0
    return axes


def _across(inertia: Array, axis: Array) -> float:
    """Return the mean moment across an axis."""
    return float(np.trace((np.eye(3) - np.outer(axis, axis)) @ inertia) / 2)


class Hanger:
    """A change of body states that turns rods about themselves as Cardan joints would.

    Args:
        mechanism: Mechanism of the scene, whose tree parents hold the joints.
        axes: Unit axes in native frames, zero for bodies that stay as they are, (body, 3).
    """

    def __init__(self, mechanism: Mechanism, axes: Array) -> None:
        self._axes = axes
        self._joints = [
            (link.body, link.parent, np.stack([*rotation.normal_to(axis), axis], axis=-1))
            for link in mechanism.links
            if (axis := axes[link.body]).any()
        ]

    def turn_rods(self, bodies: BodyStates) -> BodyStates:
        """Return states of all bodies with the rods turned, shape (…, body, …)."""
        turns, spin = rotation.matrix(bodies.native), bodies.angular_velocity.copy()
        points = np.einsum("...bij,bj->...bi", turns, self._axes)
        # Matrices, because this is called with a few states at a time.
        for body, above, basis in self._joints:
            on_world = above == WORLD_INDEX
            parent = np.eye(3) if on_world else turns[..., above, :, :]
            rate = np.zeros(3) if on_world else spin[..., above, :]
            frame, point = parent @ basis, points[..., body, :]
            aside, ahead = (np.vecdot(point, frame[..., k])[..., None] for k in (1, 2))
            cosine = np.hypot(aside, ahead)
            second = (ahead * frame[..., 1] - aside * frame[..., 2]) / cosine
            first = rotation.cross(second, point)
            turns[..., body, :, :] = np.stack([first, second, point], axis=-1) @ basis.T
            relative = spin[..., body, :] - rate
            along, across = (np.vecdot(relative, axis)[..., None] for axis in (first, second))
            spin[..., body, :] = rate + along / cosine * frame[..., 0] + across * second
        rods = self._axes.any(axis=-1, keepdims=True)
        native = np.where(rods, rotation.from_matrix(turns), bodies.native)
        return BodyStates(bodies.position, native, bodies.velocity, spin)


def _cross_axes(axes: Array) -> Array:
    """Return both axes of each joint, the first of which is fixed in the parent, (…, 2, 3)."""
    return np.stack(rotation.normal_to(axes), axis=-2)


def _angles(turn: Array, rate: Array, cross: Array) -> tuple[Array, Array]:
    """Compute both angles of Cardan joints and their rates from relative rotations.

    Args:
        turn: Rotations of the joints, child to parent, shape (…, joint, 4).
        rate: Angular velocities in the children's frames, shape (…, joint, 3).
        cross: Axes from `_cross_axes`.

    Returns:
        Angles and rates, shape (…, joint, 2).
    """
    along = np.einsum("...ji,jki->...jk", turn[..., 1:], cross)
    angles = 2.0 * np.arctan2(along, turn[..., :1])
    rates = np.einsum("...ji,jki->...jk", rate, cross)
    rates[..., 0] /= np.cos(angles[..., 1])
    return angles, rates


def _rotations(angles: Array, rates: Array, cross: Array) -> tuple[Array, Array]:
    """Invert `_angles`: return rotations (…, joint, 4) and rates in the children's frames."""
    first, second = (rotation.from_vector(angles[..., [k]] * cross[:, k]) for k in range(2))
    first_rate = rotation.rotate(rotation.conjugate(second), rates[..., :1] * cross[:, 0])
    return rotation.multiply(first, second), first_rate + rates[..., 1:] * cross[:, 1]
