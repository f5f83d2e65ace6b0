"""Do the joints hold: the gap between anchor points, the angle between axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import PlacedJoint, PointPair

__all__ = ["angle_gap", "gap", "pair_distance", "with_world"]

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


def _apart(states: BodyStates, joints: list[PlacedJoint]) -> Array:
    parent, child = _ends(joints)
    return _points(states, child, [j.in_child for j in joints]) - _points(
        states, parent, [j.in_parent for j in joints]
    )


def _off_axis(states: BodyStates, sliders: list[PlacedJoint]) -> Array:
    parent, _ = _ends(sliders)
    axes = np.array([j.axis for j in sliders]).reshape(-1, 3)
    return np.linalg.norm(
        np.cross(rotation.rotate(states.native[..., parent, :], axes), _apart(states, sliders)),
        axis=-1,
    )


def _points(states: BodyStates, bodies: list[int], offsets: list[Array]) -> Array:
    arms = np.array(offsets).reshape(-1, 3)
    return states.position[..., bodies, :] + rotation.rotate(states.native[..., bodies, :], arms)


def _ends(joints: list[PlacedJoint]) -> tuple[list[int], list[int]]:
    return [j.parent for j in joints], [j.child for j in joints]


def _lengths(pairs: tuple[PointPair, ...]) -> Array:
    return np.array([pair.length for pair in pairs])
