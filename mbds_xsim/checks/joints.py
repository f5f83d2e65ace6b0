"""Do the joints hold: gaps between anchor points, angles between axes, and the rates of both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import PlacedJoint, PointPair

Array = NDArray[np.float64]


def gap(record: Record) -> Finding | None:
    """Measure the distance between the anchor points of each joint [m]; None without joints.

    Of a slider it is the distance of the child's anchor from the parent's axis, of a distance
    link the change of its length.
    """
    mechanism, scene = record.mechanism, record.scene
    if not mechanism.joints and not mechanism.distances:
        return None
    states = with_world(record.bodies)
    joints = [j for j in mechanism.joints if j.kind != "slider"]
    sliders = [j for j in mechanism.joints if j.kind == "slider"]
    parts = [
        rotation.norm(_apart(states, joints)),
        _off_axis(states, sliders),
        np.abs(pair_distance(states, mechanism.distances) - _lengths(mechanism.distances)),
    ]
    names = [f"joint {j.name}" for j in [*joints, *sliders]]
    names += [f"distance link {link.name}" for link in mechanism.distances]
    return Finding.of(
        "gap", "m", np.concatenate(parts, axis=-1), budget=scene.budget.gap, names=tuple(names)
    )


def gap_rate(record: Record) -> Finding | None:
    """Measure the speed at which the gap of each joint opens [m/s]; None without joints.

    It may open the gap's budget in a frame. Velocities that lag as the method declares keep to
    joints as they were a step before; what places that turn make of that is left out.
    """
    mechanism = record.mechanism
    if not mechanism.joints and not mechanism.distances:
        return None
    states = with_world(record.bodies)
    joints = [j for j in mechanism.joints if j.kind != "slider"]
    sliders = [j for j in mechanism.joints if j.kind == "slider"]
    shift = _parting(states, sliders)
    parent, _ = _ends(sliders)
    axes = rotation.rotate(states.native[..., parent, :], _axes(sliders))
    shift = shift - rotation.cross(states.angular_velocity[..., parent, :], _apart(states, sliders))
    parts = [
        rotation.norm(_parting(states, joints)),
        rotation.norm(rotation.cross(axes, shift)),
        np.abs(pair_rate(states, mechanism.distances)),
    ]
    late = _turned(record, rotation.norm(record.bodies.velocity))
    names = [f"joint {j.name}" for j in [*joints, *sliders]]
    names += [f"distance link {link.name}" for link in mechanism.distances]
    return Finding.of(
        "gap rate",
        "m/s",
        np.maximum(np.concatenate(parts, axis=-1) - late, 0.0),
        budget=record.scene.budget.gap / record.frame,
        names=tuple(names),
    )


def angle_gap_rate(record: Record) -> Finding | None:
    """Measure the rate at which hinges tilt, and sliders and fixed joints turn [rad/s]; else None.

    As `gap_rate`, of angles.
    """
    joints = [j for j in record.mechanism.joints if j.kind != "ball"]
    if not joints:
        return None
    states = with_world(record.bodies)
    parent, child = _ends(joints)
    spins = [states.angular_velocity[..., ends, :] for ends in (parent, child)]
    turning = spins[1] - spins[0]
    free = np.array([j.axis if j.kind == "hinge" else np.zeros(3) for j in joints])
    free = rotation.rotate(states.native[..., parent, :], free)
    across = turning - rotation.dot(turning, free)[..., None] * free
    late = _turned(record, rotation.norm(record.bodies.angular_velocity))
    return Finding.of(
        "angle gap rate",
        "rad/s",
        np.maximum(rotation.norm(across) - late, 0.0),
        budget=record.scene.budget.angle_gap / record.frame,
        names=tuple(f"joint {j.name}" for j in joints),
    )


def angle_gap(record: Record) -> Finding | None:
    """Measure hinges' angle between axes, sliders' and fixed joints' turn [rad]; else None."""
    joints = [j for j in record.mechanism.joints if j.kind != "ball"]
    if not joints:
        return None
    states = with_world(record.bodies)
    parent, child = _ends(joints)
    back = rotation.conjugate(states.native[..., parent, :])
    turn = rotation.multiply(back, states.native[..., child, :])
    # A hinge's free turn is taken out: the rest is a swing of sine |across| of its half angle.
    free = np.array([j.axis if j.kind == "hinge" else np.zeros(3) for j in joints])
    along = np.sum(turn[..., 1:] * free, axis=-1)
    across = np.linalg.norm(turn[..., 1:] - along[..., None] * free, axis=-1)
    return Finding.of(
        "angle gap",
        "rad",
        2.0 * np.arctan2(across, np.hypot(turn[..., 0], along)),
        budget=record.scene.budget.angle_gap,
        names=tuple(f"joint {j.name}" for j in joints),
    )


def with_world(bodies: BodyStates) -> BodyStates:
    """Append the world as a last body at rest, so that index −1 finds it."""
    zero = np.zeros((*bodies.position.shape[:-2], 1, 3))
    still = np.broadcast_to(rotation.IDENTITY, (*zero.shape[:-1], 4))
    return BodyStates(
        np.concatenate([bodies.position, zero], axis=-2),
        np.concatenate([bodies.native, still], axis=-2),
        np.concatenate([bodies.velocity, zero], axis=-2),
        np.concatenate([bodies.angular_velocity, zero], axis=-2),
    )


def pair_distance(states: BodyStates, pairs: tuple[PointPair, ...]) -> Array:
    """Distances of attachment points [m], shape (…, pair), of states with the world."""
    ends = [
        _points(states, [pair.bodies[k] for pair in pairs], [pair.in_body[k] for pair in pairs])
        for k in (0, 1)
    ]
    return np.linalg.norm(ends[1] - ends[0], axis=-1)


def pair_rate(states: BodyStates, pairs: tuple[PointPair, ...]) -> Array:
    """Rates of the distances of attachment points [m/s], (…, pair), of states with the world."""
    ends = [
        ([pair.bodies[k] for pair in pairs], [pair.in_body[k] for pair in pairs]) for k in (0, 1)
    ]
    apart = _points(states, *ends[1]) - _points(states, *ends[0])
    parting = _speeds(states, *ends[1]) - _speeds(states, *ends[0])
    return np.asarray(rotation.dot(parting, apart / rotation.norm(apart)[..., None]))


def _turned(record: Record, speeds: Array) -> Array:
    """By how much a turn during the step by which velocities lag may change them, (…, frame, 1).

    Methods lag by half a step where they keep joints closed at its beginning, so it is twice the
    lag, at the fastest rate of the mechanism.
    """
    fastest = rotation.norm(record.bodies.angular_velocity).max(axis=-1, keepdims=True)
    return np.asarray(2.0 * abs(record.lag) * fastest * speeds.max(axis=-1, keepdims=True))


def _parting(states: BodyStates, joints: list[PlacedJoint]) -> Array:
    """Velocity of the child's anchor from the parent's, in W [m/s], shape (…, joint, 3)."""
    parent, child = _ends(joints)
    return _speeds(states, child, [j.in_child for j in joints]) - _speeds(
        states, parent, [j.in_parent for j in joints]
    )


def _speeds(states: BodyStates, bodies: list[int], offsets: list[Array]) -> Array:
    spin = states.angular_velocity[..., bodies, :]
    return states.velocity[..., bodies, :] + rotation.cross(spin, _arms(states, bodies, offsets))


def _apart(states: BodyStates, joints: list[PlacedJoint]) -> Array:
    parent, child = _ends(joints)
    return _points(states, child, [j.in_child for j in joints]) - _points(
        states, parent, [j.in_parent for j in joints]
    )


def _off_axis(states: BodyStates, sliders: list[PlacedJoint]) -> Array:
    parent, _ = _ends(sliders)
    axes = rotation.rotate(states.native[..., parent, :], _axes(sliders))
    return rotation.norm(rotation.cross(axes, _apart(states, sliders)))


def _points(states: BodyStates, bodies: list[int], offsets: list[Array]) -> Array:
    return states.position[..., bodies, :] + _arms(states, bodies, offsets)


def _arms(states: BodyStates, bodies: list[int], offsets: list[Array]) -> Array:
    return rotation.rotate(states.native[..., bodies, :], np.array(offsets).reshape(-1, 3))


def _axes(joints: list[PlacedJoint]) -> Array:
    return np.array([j.axis for j in joints]).reshape(-1, 3)


def _ends(joints: list[PlacedJoint]) -> tuple[list[int], list[int]]:
    return [j.parent for j in joints], [j.child for j in joints]


def _lengths(pairs: tuple[PointPair, ...]) -> Array:
    return np.array([pair.length for pair in pairs])
