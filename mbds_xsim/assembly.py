"""The start of a scene: poses that close every loop, velocities that keep every joint together."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.constraints import constraint_rows, dense_jacobian
from mbds_xsim.errors import SceneError
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism, PlacedJoint

__all__ = ["Start", "assemble", "joint_coordinate", "velocity_violation"]

Array = NDArray[np.float64]

_STRIDE = 0.1  # largest change of a joint coordinate between two solves [rad, or lengths]
_NEWTON_STEPS = 30
_CLOSED = 1e-12  # of the scene's length
_VELOCITY_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Start:
    """One state: arrays of shape (body, 3|4), native rotations."""

    position: Array
    native: Array
    velocity: Array
    angular_velocity: Array


@functools.lru_cache(maxsize=64)
def assemble(mechanism: Mechanism) -> Start:
    """Find the scene's own start: joint `start` and `rate`, body velocities, all loops closed.

    Poses move from the reference pose by mass-weighted Newton steps with the given joint
    coordinates led to their values in small strides. Velocities that are not given are the ones
    of least kinetic energy.

    Raises:
        SceneError: A loop cannot be closed, or given velocities break a joint.
    """
    position, native = _assemble_pose(mechanism)
    velocity, angular_velocity = _complete_velocities(mechanism, position, native)
    return Start(position, native, velocity, angular_velocity)


def joint_coordinate(joint: PlacedJoint, position: Array, native: Array) -> Array:
    """Hinge angle in (−π, π] [rad] or slider displacement [m]; leading axes are kept."""
    x, q = _with_world(position, native)
    xp, xc = x[..., joint.parent, :], x[..., joint.child, :]
    qp, qc = q[..., joint.parent, :], q[..., joint.child, :]
    if joint.kind == "slider":
        apart = xc + rotation.rotate(qc, joint.in_child) - xp - rotation.rotate(qp, joint.in_parent)
        return np.asarray(np.sum(apart * rotation.rotate(qp, joint.axis), axis=-1))
    return rotation.angle_about(rotation.multiply(rotation.conjugate(qp), qc), joint.axis)


def velocity_violation(mechanism: Mechanism, start: Start) -> tuple[float, str]:
    """Give the largest rate at which a constraint is broken [m/s or rad/s], and its name."""
    rows = constraint_rows(
        mechanism, start.position, start.native, start.velocity, start.angular_velocity
    )
    if not len(rows.parent):
        return 0.0, ""
    twist = np.concatenate([start.velocity, start.angular_velocity], axis=-1).reshape(-1)
    rate = np.abs(dense_jacobian(rows, mechanism.body_count) @ twist)
    worst = int(np.argmax(rate))
    return float(rate[worst]), _owner_name(mechanism, int(rows.owner[worst]))


def _assemble_pose(mechanism: Mechanism) -> tuple[Array, Array]:
    scene = mechanism.scene
    led = [
        (placed, float(joint.start))
        for placed, joint in zip(mechanism.joints, scene.joints, strict=True)
        if joint.start is not None
    ]
    position = mechanism.com.copy()
    native = np.tile(rotation.IDENTITY, (mechanism.body_count, 1))
    strides = max([1, *(int(np.ceil(abs(target) / _STRIDE)) for _, target in led)])
    for k in range(1, strides + 1):
        goal = [(joint, target * k / strides) for joint, target in led]
        position, native = _close(mechanism, position, native, goal)
    return position, native


def _close(
    mechanism: Mechanism, position: Array, native: Array, led: list[tuple[PlacedJoint, float]]
) -> tuple[Array, Array]:
    still = np.zeros_like(position)
    residual = np.zeros(0)
    owner = np.zeros(0, dtype=np.int64)
    for _ in range(_NEWTON_STEPS):
        rows = constraint_rows(mechanism, position, native, still, still)
        ahead = [
            _wrapped(joint, float(joint_coordinate(joint, position, native)) - target)
            for joint, target in led
        ]
        residual = np.concatenate([rows.residual, ahead])
        owner = np.concatenate([rows.owner, [joint.index for joint, _ in led]]).astype(np.int64)
        if np.abs(residual).max(initial=0.0) < _CLOSED * max(1.0, mechanism.scene.length):
            return position, native
        jacobian = np.concatenate(
            [
                dense_jacobian(rows, mechanism.body_count),
                *(_rate_row(mechanism, joint, position, native)[None] for joint, _ in led),
            ]
        )
        step = -_least_energy(mechanism, native, jacobian, residual).reshape(-1, 2, 3)
        position = position + step[:, 0]
        native = rotation.multiply(rotation.from_vector(step[:, 1]), native)
    worst = int(np.argmax(np.abs(residual)))
    name = _owner_name(mechanism, int(owner[worst]))
    msg = (
        f"{name} cannot be closed: the start leaves it off by {abs(residual[worst]):.3g} m or "
        f"rad, allowed is {_CLOSED * max(1.0, mechanism.scene.length):.0e}; change a length, "
        "an anchor or a joint's start"
    )
    raise SceneError(msg)


def _complete_velocities(
    mechanism: Mechanism, position: Array, native: Array
) -> tuple[Array, Array]:
    scene = mechanism.scene
    still = np.zeros_like(position)
    rows = constraint_rows(mechanism, position, native, still, still)
    jacobian = [dense_jacobian(rows, mechanism.body_count)]
    wanted: list[float] = [0.0] * len(rows.parent)
    names = [_owner_name(mechanism, int(owner)) for owner in rows.owner]
    for placed, joint in zip(mechanism.joints, scene.joints, strict=True):
        if joint.rate is not None:
            jacobian.append(_rate_row(mechanism, placed, position, native)[None])
            wanted.append(joint.rate)
            names.append(f"joints[{joint.name!r}].rate")
    unit = np.eye(6 * mechanism.body_count)
    for k, body in enumerate(scene.bodies):
        for offset, key in ((0, "velocity"), (3, "angular_velocity")):
            given = getattr(body, key)
            if given is not None:
                jacobian.append(unit[6 * k + offset : 6 * k + offset + 3])
                wanted += given
                names += [f"bodies[{body.name!r}].{key}"] * 3
    if not any(wanted):
        return still, still.copy()
    matrix, goal = np.concatenate(jacobian), np.array(wanted)
    twist = _least_energy(mechanism, native, matrix, goal)
    off = np.abs(matrix @ twist - goal)
    worst = int(np.argmax(off))
    allowed = _VELOCITY_TOLERANCE * max(1.0, float(np.abs(goal).max()))
    if off[worst] > allowed:
        msg = (
            f"the initial velocities contradict each other at {names[worst]}: off by "
            f"{off[worst]:.3g} m/s or rad/s, allowed is {allowed:.0e}; leave out those that follow "
            "from the joints"
        )
        raise SceneError(msg)
    parts = twist.reshape(-1, 2, 3)
    return parts[:, 0].copy(), parts[:, 1].copy()


def _least_energy(mechanism: Mechanism, native: Array, matrix: Array, goal: Array) -> Array:
    """Solve matrix · twist = goal in the least squares sense, of least kinetic energy."""
    turn = rotation.matrix(native)
    inertia = turn @ mechanism.inertia @ np.swapaxes(turn, -1, -2)
    values, vectors = np.linalg.eigh(inertia)
    root = np.zeros((mechanism.body_count, 6, 6))
    root[:, :3, :3] = np.eye(3) / np.sqrt(mechanism.mass)[:, None, None]
    root[:, 3:, 3:] = vectors / np.sqrt(values)[:, None, :] @ np.swapaxes(vectors, -1, -2)
    scaled = (matrix.reshape(len(matrix), -1, 1, 6) @ root)[:, :, 0].reshape(len(matrix), -1)
    answer = np.linalg.lstsq(scaled, goal, rcond=1e-10)[0]
    return np.asarray((root @ answer.reshape(-1, 6, 1))[..., 0]).reshape(-1)


def _rate_row(mechanism: Mechanism, joint: PlacedJoint, position: Array, native: Array) -> Array:
    """Row that gives a hinge's or slider's rate from the twists, shape (6 · body,)."""
    x, q = _with_world(position, native)
    axis = rotation.rotate(q[joint.parent], joint.axis)
    row = np.zeros((mechanism.body_count + 1, 6))
    if joint.kind == "hinge":
        row[joint.child, 3:] = axis
        row[joint.parent, 3:] = -axis
    else:
        arm_parent = x[joint.child] + rotation.rotate(q[joint.child], joint.in_child)
        arm_child = arm_parent - x[joint.child]
        arm_parent = arm_parent - x[joint.parent]
        row[joint.child] = [*axis, *np.cross(arm_child, axis)]
        row[joint.parent] = [*-axis, *-np.cross(arm_parent, axis)]
    row[WORLD_INDEX] = 0.0
    return row[:-1].reshape(-1)


def _wrapped(joint: PlacedJoint, difference: float) -> float:
    if joint.kind == "slider":
        return difference
    return float((difference + np.pi) % (2 * np.pi) - np.pi)


def _with_world(position: Array, native: Array) -> tuple[Array, Array]:
    lead = position.shape[:-2]
    x = np.concatenate([position, np.zeros((*lead, 1, 3))], axis=-2)
    q = np.concatenate([native, np.broadcast_to(rotation.IDENTITY, (*lead, 1, 4))], axis=-2)
    return x, q


def _owner_name(mechanism: Mechanism, owner: int) -> str:
    joints = mechanism.scene.joints
    if owner < len(joints):
        return f"joints[{joints[owner].name!r}]"
    return f"distance_links[{mechanism.scene.distance_links[owner - len(joints)].name!r}]"
