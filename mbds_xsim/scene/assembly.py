"""Initial state of a scene: poses that close every loop, velocities that satisfy every joint."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Literal

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.constraints import ConstraintRows, constraint_rows, sparse_jacobian
from mbds_xsim.scene.joint_space import (
    BodyStates,
    coupling_gaps,
    coupling_rows,
    joint_coordinate,
    rate_row,
    to_bodies,
    to_links,
)
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_Goal = list[tuple[PlacedJoint, float]]  # joints, each with the coordinate that it must have

_STRIDE = 0.1  # largest change of a joint coordinate between two solves [rad or scene lengths]
_MOST_STRIDES = 1000
_NEWTON_STEPS = 50
_LONGEST_STEP = 0.5  # largest Newton step [rad or scene lengths], against divergence
_CLOSED = 1e-12  # relative to the scene's length
_GAP_TOLERANCE = 1e-9
_VELOCITY_TOLERANCE = 1e-9
_BRANCH_TOLERANCE = 1e-6


@functools.lru_cache(maxsize=64)
def assemble(mechanism: Mechanism) -> BodyStates:
    """Find the scene's initial state from joint `start` and `rate` and body velocities.

    A tree is assembled joint by joint if all its coordinates, or rates, are given. Otherwise
    mass-weighted Newton steps move the bodies from the reference pose and close all loops, while
    the given joint coordinates approach their values in small strides. Velocities that are not
    given are those of least kinetic energy.

    Raises:
        SceneError: A loop cannot be closed, or given velocities break a joint.
    """
    start = BodyStates.at_reference(mechanism)
    if not (mechanism.joints or mechanism.distances):  # so all bodies are free
        bodies = mechanism.scene.bodies
        velocity = np.array([body.velocity or (0.0, 0.0, 0.0) for body in bodies])
        spin = np.array([body.angular_velocity or (0.0, 0.0, 0.0) for body in bodies])
        return dataclasses.replace(start, velocity=velocity, angular_velocity=spin)
    if not _follows_from(mechanism, "start"):
        start = _assemble_pose(mechanism, start)
    start = _on_its_tree(mechanism, start)
    if _follows_from(mechanism, "rate"):
        return start
    return _on_its_tree(mechanism, _complete_velocities(mechanism, start))


def _follows_from(mechanism: Mechanism, key: Literal["start", "rate"]) -> bool:
    """Return whether the joints' `key` alone fixes poses or rates: a tree of hinges and sliders."""
    joints = mechanism.scene.joints
    velocities = (body.velocity or body.angular_velocity for body in mechanism.scene.bodies)
    return not (
        mechanism.loops
        or mechanism.distances
        or mechanism.couplings
        or (key == "rate" and any(velocities))
    ) and all(
        link.joint is not None
        and link.joint.kind != "ball"
        and (link.joint.kind == "fixed" or getattr(joints[link.joint.index], key) is not None)
        for link in mechanism.links
    )


def _on_its_tree(mechanism: Mechanism, start: BodyStates) -> BodyStates:
    """Remove rounding errors from the tree's joints and from given coordinates."""
    joints = mechanism.scene.joints
    moves = start.velocity.any() or start.angular_velocity.any()
    if not moves and all(joint.start is None and joint.rate is None for joint in joints):
        return start
    links = to_links(mechanism, start)
    if not (mechanism.loops or mechanism.distances):
        for k, link in enumerate(mechanism.links):
            scene_joint = None if link.joint is None else joints[link.joint.index]
            if scene_joint is not None and scene_joint.start is not None:
                links.coordinate[k] = scene_joint.start
            if scene_joint is not None and scene_joint.rate is not None:
                links.rate[k] = scene_joint.rate
    return to_bodies(mechanism, links)


def check_joints(mechanism: Mechanism, starts: BodyStates) -> None:
    """Raise SceneError, naming the joint, unless poses and velocities satisfy all joints.

    `starts` may have leading axes.
    """
    rows, world = constraint_rows(mechanism, starts), starts.with_world()
    twist = np.concatenate([world.velocity, world.angular_velocity], axis=-1)
    rate = np.sum(
        rows.jacobian_parent * twist[..., rows.parent, :]
        + rows.jacobian_child * twist[..., rows.child, :],
        axis=-1,
    )
    length = max(1.0, mechanism.scene.length)
    speed = max(1.0, float(np.abs(twist).max(initial=0.0)))
    gap, veer = coupling_gaps(mechanism, starts)
    owners = _owners(mechanism, rows)
    for joint_error, coupling_error, allowed, template in (
        (rows.residual, gap, _GAP_TOLERANCE * length, "start leaves {} off by {:.3g} m or rad"),
        (rate, veer, _VELOCITY_TOLERANCE * speed, "velocities break {} at {:.3g} m/s or rad/s"),
    ):
        off = np.concatenate([joint_error, coupling_error], axis=-1)
        per_row = np.abs(off).max(axis=tuple(range(off.ndim - 1)), initial=0.0)
        if per_row.max(initial=0.0) > allowed:
            worst = int(np.argmax(per_row))
            name = _owner_name(mechanism, int(owners[worst]))
            fault = template.format(name, per_row[worst])
            way = "draw the others that this joint holds along with it"
            if name.startswith("couplings"):
                way = "draw the joint that is followed, and no hinge past half a turn"
            raise SceneError(
                f"sampling: the drawn {fault}, allowed is {allowed:.0e}; {way}, "
                "or leave the draw out"
            )


def check_limits(mechanism: Mechanism, starts: BodyStates) -> None:
    """Raise SceneError, naming the joint, unless poses are within all joint limits."""
    for joint in mechanism.limited:
        past = joint.beyond(joint_coordinate(joint, starts.position, starts.native)).max(initial=0)
        if past > _GAP_TOLERANCE:
            raise SceneError(
                f"the start of joint {joint.name!r} is {past:.3g} rad or m past its limits, "
                f"allowed is {list(joint.limits or ())}; start it within"
            )


def _assemble_pose(mechanism: Mechanism, start: BodyStates) -> BodyStates:
    scene = mechanism.scene
    pairs = [(placed, scene.joints[placed.index]) for placed in mechanism.joints]
    targets = [(placed, float(joint.start)) for placed, joint in pairs if joint.start is not None]
    unit = {"hinge": _STRIDE, "slider": _STRIDE * scene.length}
    needed = max([1.0, *(abs(target) / unit[joint.kind] for joint, target in targets)])
    strides = min(int(np.ceil(needed)), _MOST_STRIDES)
    for k in range(1, strides + 1):
        goal = [(joint, target * k / strides) for joint, target in targets]
        start = _close(mechanism, start, goal, share=k / strides)
    return start


def _close(mechanism: Mechanism, start: BodyStates, goal: _Goal, *, share: float) -> BodyStates:
    """Take Newton steps until loops close and joints meet their goal, and one more at the start.

    `share` is the part of the way from the reference pose to the start.
    """
    tolerance = _CLOSED * max(1.0, mechanism.scene.length)
    rows, residual, owner = _pose_rows(mechanism, start, goal)
    again = share == 1.0
    for _ in range(_NEWTON_STEPS):
        off = np.abs(residual).max(initial=0.0)
        if off < tolerance and not (again and off > 0.0):
            return start
        again = again and not off < tolerance
        jacobian = _stacked(mechanism, start, rows, [joint for joint, _ in goal])
        step = -_least_energy(mechanism, start, jacobian, residual).reshape(-1, 2, 3)
        reach = max(np.abs(step[:, 0]).max() / mechanism.scene.length, np.abs(step[:, 1]).max())
        step *= min(1.0, _LONGEST_STEP / reach)
        native = rotation.multiply(rotation.from_vector(step[:, 1]), start.native)
        start = dataclasses.replace(start, position=start.position + step[:, 0], native=native)
        rows, residual, owner = _pose_rows(mechanism, start, goal)
    # A tree always closes, so one of the other constraints is to blame.
    tree = [link.joint.index for link in mechanism.links if link.joint is not None]
    blamed = np.where(np.isin(owner, tree) & (np.arange(len(owner)) < len(owner) - len(goal)), 0, 1)
    worst = int(np.argmax(np.abs(residual) * blamed))
    name, way = _owner_name(mechanism, int(owner[worst])), "a length, an anchor or a joint's start"
    if name.startswith("couplings"):
        way = "the offset or a joint's start, so that no coupled hinge starts past half a turn"
    place = "the start" if share == 1.0 else f"{100 * share:.3g} % of the way to the start"
    raise SceneError(
        f"{name} cannot be closed: {place} leaves it off by {abs(residual[worst]):.3g} m or rad, "
        f"allowed is {tolerance:.0e}; change {way}"
    )


def _pose_rows(
    mechanism: Mechanism, start: BodyStates, goal: _Goal
) -> tuple[ConstraintRows, Array, Index]:
    """Return all constraint rows; residual and owner of these, couplings, joints with a goal."""
    rows = constraint_rows(mechanism, start)
    deviations = [
        _wrapped(joint, float(joint_coordinate(joint, start.position, start.native)) - target)
        for joint, target in goal
    ]
    off, _ = coupling_gaps(mechanism, start)
    owners = np.concatenate([_owners(mechanism, rows), [joint.index for joint, _ in goal]])
    return rows, np.concatenate([rows.residual, off, deviations]), owners


def _stacked(
    mechanism: Mechanism, start: BodyStates, rows: ConstraintRows, joints: list[PlacedJoint]
) -> csr_array:
    """Return the Jacobian of constraint rows, of couplings and of joints' coordinates."""
    from scipy.sparse import vstack  # takes long to import

    couplings = coupling_rows(mechanism, start)
    rates = (rate_row(mechanism, joint, start) for joint in joints)
    parts = [sparse_jacobian(rows, mechanism.body_count), *couplings, *rates]
    return vstack(parts, format="csr")


def _complete_velocities(mechanism: Mechanism, start: BodyStates) -> BodyStates:
    scene = mechanism.scene
    given = (value for body in scene.bodies for value in (body.velocity, body.angular_velocity))
    if not (any(joint.rate for joint in scene.joints) or any(map(any, filter(None, given)))):
        still = np.zeros_like(start.position)
        return dataclasses.replace(start, velocity=still, angular_velocity=still.copy())
    from scipy.sparse import eye_array, vstack  # takes long to import

    rows = constraint_rows(mechanism, start)
    names = [_owner_name(mechanism, int(owner)) for owner in _owners(mechanism, rows)]
    wanted: list[float] = [0.0] * len(names)
    turning = [joint for joint in mechanism.joints if scene.joints[joint.index].rate is not None]
    jacobian = [_stacked(mechanism, start, rows, turning)]
    wanted += (scene.joints[joint.index].rate or 0.0 for joint in turning)
    names += (f"joints[{joint.name!r}].rate" for joint in turning)
    unit = eye_array(6 * mechanism.body_count, format="csr")
    for k, body in enumerate(scene.bodies):
        for offset, key in ((0, "velocity"), (3, "angular_velocity")):
            value = getattr(body, key)
            if value is not None:
                jacobian.append(unit[6 * k + offset : 6 * k + offset + 3])
                wanted += value
                names += [f"bodies[{body.name!r}].{key}"] * 3
    matrix, goal = vstack(jacobian, format="csr"), np.array(wanted)
    twist = _least_energy(mechanism, start, matrix, goal)
    off = np.abs(matrix @ twist - goal)
    worst = int(np.argmax(off))
    allowed = _VELOCITY_TOLERANCE * max(1.0, float(np.abs(goal).max()))
    if off[worst] > allowed:
        raise SceneError(
            f"the initial velocities contradict each other at {names[worst]}: off by "
            f"{off[worst]:.3g} m/s or rad/s, allowed is {allowed:.0e}; leave out those that follow "
            "from the joints"
        )
    parts = twist.reshape(-1, 2, 3)
    start = dataclasses.replace(
        start, velocity=parts[:, 0].copy(), angular_velocity=parts[:, 1].copy()
    )
    _check_branch(mechanism, start)
    return start


def _check_branch(mechanism: Mechanism, start: BodyStates) -> None:
    """Raise SceneError if velocities satisfy the joints but no acceleration keeps doing so.

    This happens only in singular poses, where dependent rows curve in different ways.
    """
    if not (mechanism.loops or mechanism.distances):
        return
    rows = constraint_rows(mechanism, start)
    jacobian = sparse_jacobian(rows, mechanism.body_count)
    off = np.abs(jacobian @ _least_energy(mechanism, start, jacobian, -rows.bias) + rows.bias)
    worst = int(np.argmax(off))
    if off[worst] > _BRANCH_TOLERANCE * np.abs(rows.bias).max():
        raise SceneError(
            f"the start is a bifurcation at {_owner_name(mechanism, int(rows.owner[worst]))}: the "
            "pose is singular and its motion could go on in several ways, but the initial "
            "velocities belong to none of them; give the rate of one more joint in one of these "
            "motions, or another start"
        )


def _least_energy(mechanism: Mechanism, start: BodyStates, matrix: csr_array, goal: Array) -> Array:
    """Solve matrix · twist = goal with the twists of least kinetic energy."""
    from scipy.sparse import block_array, diags_array, eye_array, vstack

    from mbds_xsim.scene.row_space import least_change

    root, rotors = inverse_mass_root(mechanism, start.native), mechanism.rotors
    if not rotors:
        return least_change(matrix, root, goal)
    # A rotor is a mass with its own speed, which is tied to its joint's rate.
    rates = vstack([rate_row(mechanism, joint, start) for joint in rotors])
    extended = block_array([[matrix, None], [rates, -eye_array(len(rotors))]], format="csr")
    rotor_root = diags_array(1.0 / np.sqrt([joint.armature for joint in rotors]))
    extended_root = block_array([[root, None], [None, rotor_root]], format="csr")
    goal = np.concatenate([goal, np.zeros(len(rotors))])
    return least_change(extended, extended_root, goal)[: -len(rotors)]


def inverse_mass_root(mechanism: Mechanism, native: Array) -> csr_array:
    """Return the symmetric square root of the inverse mass matrix of all twists in W."""
    from scipy.sparse import bsr_array

    turn = rotation.matrix(native)
    inertia = turn @ mechanism.inertia @ np.swapaxes(turn, -1, -2)
    values, vectors = np.linalg.eigh(inertia)
    root = np.zeros((mechanism.body_count, 2, 3, 3))
    root[:, 0] = np.eye(3) / np.sqrt(mechanism.mass)[:, None, None]
    root[:, 1] = vectors / np.sqrt(values)[:, None, :] @ np.swapaxes(vectors, -1, -2)
    blocks = np.arange(2 * mechanism.body_count + 1)
    return bsr_array((root.reshape(-1, 3, 3), blocks[:-1], blocks)).tocsr()


def _wrapped(joint: PlacedJoint, difference: float) -> float:
    if joint.kind == "slider":
        return difference
    return float((difference + np.pi) % (2 * np.pi) - np.pi)


def _owners(mechanism: Mechanism, rows: ConstraintRows) -> Index:
    """Return the owner of each row: joints, then distance links, then couplings."""
    count = len(mechanism.joints) + len(mechanism.distances)
    return np.concatenate([rows.owner, count + np.arange(len(mechanism.couplings))])


def _owner_name(mechanism: Mechanism, owner: int) -> str:
    for table in ("joints", "distance_links", "couplings"):
        items = getattr(mechanism.scene, table)
        if owner < len(items):
            return f"{table}[{items[owner].name!r}]"
        owner -= len(items)
    raise AssertionError(owner)
