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
    """Return a joint's coordinate [rad or m], shape (trajectory, frame).

    A hinge's angle is in (−π, π] at the start, and counts whole turns from then on.

    Args:
        joint: A hinge or slider.
        world: Recorded states with the world as last body.
        frame: Interval between frames [s].
    """
    coordinate = joint_coordinate(joint, world.position, world.native)
    if joint.kind == "hinge":
        coordinate[:, 1:] = coordinate[:, :1] + joint_turns(joint, world, frame).cumsum(axis=1)
    return coordinate


def clear_of_stops(
    mechanism: Mechanism, world: BodyStates, frame: float, group: tuple[int, ...] | None
) -> Mask:
    """Find the steps in which no joint can reach a stop, shape (trajectory, step).

    At both ends a joint must be farther from its stops than it can move in a frame, at the larger
    rate of both ends plus their difference.

    Args:
        mechanism: Mechanism of the recorded motion.
        world: Recorded states with the world as last body.
        frame: Interval between frames [s].
        group: Only joints between the world and these bodies count; None: all joints count.
    """
    clear = np.ones(world.position[:, 1:, 0, 0].shape, dtype=bool)
    for joint in mechanism.limited:
        ends = {joint.parent, joint.child}
        if group is None or (WORLD_INDEX in ends and ends & {*group}):
            clear &= clear_of_own(joint, world, frame)
    return clear


def clear_of_own(joint: PlacedJoint, world: BodyStates, frame: float) -> Mask:
    """Find the steps in which one joint cannot reach its stops, shape (trajectory, step)."""
    gap = stop_gap(joint, counted_coordinate(joint, world, frame))
    rate = joint_rate(joint, world)
    begin, end = rate[:, :-1], rate[:, 1:]
    travel = frame * (np.maximum(np.abs(begin), np.abs(end)) + np.abs(end - begin))
    return np.asarray(np.minimum(gap[:, :-1], gap[:, 1:]) > travel)


def stop_gap(joint: PlacedJoint, coordinate: Array) -> Array:
    """Return a joint's distance from the nearer of its stops [rad or m], negative past it."""
    assert joint.limits is not None
    low, high = joint.limits
    return np.minimum(coordinate - low, high - coordinate)


@functools.lru_cache(maxsize=1)
def hinge_turns(record: Record) -> Array:
    """Compute the turns of hinges over each step [rad], shape (trajectory, step, hinge)."""
    world, frame, hinges = record.world, record.frame, record.mechanism.hinges
    return np.stack([joint_turns(joint, world, frame) for joint in hinges], axis=-1)


def coordinate_of(record: Record, joint: PlacedJoint) -> Array:
    """Return a joint's coordinate as `counted_coordinate` does, shape (trajectory, frame)."""
    return counted_coordinate(joint, record.world, record.frame)


@functools.lru_cache(maxsize=1)
def hinge_rates(record: Record) -> Array:
    """Compute angular velocities across hinges [rad/s], shape (trajectory, frame, hinge)."""
    world, hinges = record.world, record.mechanism.hinges
    return np.stack([joint_rate(joint, world) for joint in hinges], axis=-1)


def coupling_errors(record: Record, kind: str) -> tuple[Array, Array]:
    """Return errors of followers of a kind, and their rates, (trajectory, frame, coupling)."""
    couplings = [c for c in record.mechanism.couplings if c.follower.kind == kind]
    error, rate = (np.zeros((*record.finite.shape, len(couplings))) for _ in range(2))
    for k, each in enumerate(couplings):
        here, there = (coordinate_of(record, joint) for joint in (each.follower, each.leader))
        error[..., k] = here - each.ratio * there - each.offset
        leader_rate = each.ratio * joint_rate(each.leader, record.world)
        rate[..., k] = joint_rate(each.follower, record.world) - leader_rate
    return error, rate
