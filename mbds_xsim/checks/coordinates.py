"""Coordinates of joints over a recorded motion, their rates, and steps with no stop in reach."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate, joint_rate, joint_turns
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint

if TYPE_CHECKING:
    from mbds_xsim.checks.record import Record


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


@functools.lru_cache(maxsize=1)
def hinge_turns(record: Record) -> Array:
    """Angles by which the hinges turn over each step [rad], shape (trajectory, step, hinge)."""
    world, frame, hinges = record.world, record.frame, record.mechanism.hinges
    return np.stack([joint_turns(joint, world, frame) for joint in hinges], axis=-1)


def coordinate_of(record: Record, joint: PlacedJoint) -> Array:
    """Give a joint's coordinate as `counted_coordinate` does, shape (trajectory, frame)."""
    return counted_coordinate(joint, record.world, record.frame)


@functools.lru_cache(maxsize=1)
def hinge_rates(record: Record) -> Array:
    """Angular velocities across the hinges [rad/s], shape (trajectory, frame, hinge)."""
    world, hinges = record.world, record.mechanism.hinges
    return np.stack([joint_rate(joint, world) for joint in hinges], axis=-1)


def coupling_errors(record: Record, kind: str) -> tuple[Array, Array]:
    """Give how far followers of a kind are off, and their rates, (trajectory, frame, coupling)."""
    couplings = [c for c in record.mechanism.couplings if c.follower.kind == kind]
    off, rate = (np.zeros((*record.finite.shape, len(couplings))) for _ in range(2))
    for k, each in enumerate(couplings):
        here, there = (coordinate_of(record, joint) for joint in (each.follower, each.leader))
        off[..., k] = here - each.ratio * there - each.offset
        leading = each.ratio * joint_rate(each.leader, record.world)
        rate[..., k] = joint_rate(each.follower, record.world) - leading
    return off, rate
