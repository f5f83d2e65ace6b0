"""In which steps no joint can reach its stops."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate, joint_rate, joint_turns
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint


def counted_coordinate(joint: PlacedJoint, world: BodyStates, frame: float) -> Array:
    """Give a joint's coordinate [rad or m], shape (trajectory, frame).

    A hinge's angle is in (−π, π] at the start, and counts whole turns from then on.

    Args:
        joint: A hinge or slider.
        world: Recorded states, with the world.
        frame: Interval between them [s].
    """
    found = joint_coordinate(joint, world.position, world.native)
    if joint.kind == "hinge":
        found[:, 1:] = found[:, :1] + joint_turns(joint, world, frame).cumsum(axis=1)
    return found


def clear_of_stops(
    mechanism: Mechanism, world: BodyStates, frame: float, group: tuple[int, ...] | None
) -> Mask:
    """Tell in which steps stops have no part, shape (trajectory, step).

    At both ends the joint must be farther from them than it gets in a frame, at the rates of both
    ends and what lies between these.

    Args:
        mechanism: Whose motion.
        world: Recorded states, with the world.
        frame: Interval between them [s].
        group: Bodies of which only those joints count that hold one on the world; None: all count.
    """
    found = np.ones(world.position[:, 1:, 0, 0].shape, dtype=bool)
    for joint in mechanism.limited:
        ends = {joint.parent, joint.child}
        if group is None or (WORLD_INDEX in ends and ends & {*group}):
            found &= clear_of_own(joint, world, frame)
    return found


def clear_of_own(joint: PlacedJoint, world: BodyStates, frame: float) -> Mask:
    """Tell in which steps one joint stays clear of its stops, as above."""
    gap = stop_gap(joint, counted_coordinate(joint, world, frame))
    rate = joint_rate(joint, world)
    begin, end = rate[:, :-1], rate[:, 1:]
    way = frame * (np.maximum(np.abs(begin), np.abs(end)) + np.abs(end - begin))
    return np.asarray(np.minimum(gap[:, :-1], gap[:, 1:]) > way)


def stop_gap(joint: PlacedJoint, coordinate: Array) -> Array:
    """Give how far a joint is from the nearer of its stops [rad or m], below 0 past it."""
    assert joint.limits is not None
    low, high = joint.limits
    return np.minimum(coordinate - low, high - coordinate)
