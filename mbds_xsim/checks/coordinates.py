"""Coordinates of joints over a recorded motion, their rates, and steps with no stop in reach."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.scene.joint_space import joint_coordinate, joint_rate, joint_turns
from mbds_xsim.scene.mechanism import WORLD_INDEX, PlacedJoint

if TYPE_CHECKING:
    from mbds_xsim.checks.record import Record

_RESTING = 1e-9  # gap of a stop that is none [rad, or m over the scene's length]


def coordinate_of(record: Record, joint: PlacedJoint) -> Array:
    """Return a hinge's or slider's coordinate [rad or m], shape (trajectory, frame).

    A hinge's angle is in (−π, π] at the start, and counts whole turns from then on.
    """
    world = record.world
    coordinate = joint_coordinate(joint, world.position, world.native)
    if joint.kind == "hinge":
        turns = joint_turns(joint, world, record.frame)
        coordinate[:, 1:] = coordinate[:, :1] + turns.cumsum(axis=1)
    return coordinate


def clear_of_stops(record: Record, group: tuple[int, ...] | None = None) -> Mask:
    """Find the steps in which no joint can reach a stop, shape (trajectory, step).

    At both ends a joint must be farther from its stops than it can move in a frame, at the larger
    rate of both ends plus their difference. Of a group of bodies, only joints to the world count.
    """
    clear = np.ones(record.world.position[:, 1:, 0, 0].shape, dtype=bool)
    for joint in record.mechanism.limited:
        ends = {joint.parent, joint.child}
        if group is None or (WORLD_INDEX in ends and ends & {*group}):
            clear &= clear_of_own(record, joint)
    return clear


def clear_of_own(record: Record, joint: PlacedJoint) -> Mask:
    """Find the steps in which one joint cannot reach its stops, shape (trajectory, step).

    A joint that rests on its stop may be off it by rounding.
    """
    gap, rate = stop_gap(record, joint), joint_rate(joint, record.world)
    begin, end = rate[:, :-1], rate[:, 1:]
    travel = record.frame * (np.maximum(np.abs(begin), np.abs(end)) + np.abs(end - begin))
    least = _RESTING * (1.0 if joint.kind == "hinge" else record.scene.length)
    return np.asarray(np.minimum(gap[:, :-1], gap[:, 1:]) > travel + least)


def stop_gap(record: Record, joint: PlacedJoint) -> Array:
    """Return a joint's distance from the nearer of its stops [rad or m], negative past it."""
    assert joint.limits is not None
    low, high = joint.limits
    coordinate = coordinate_of(record, joint)
    return np.minimum(coordinate - low, high - coordinate)


@functools.lru_cache(maxsize=1)
def hinge_turns(record: Record) -> Array:
    """Compute the turns of hinges over each step [rad], shape (trajectory, step, hinge)."""
    world, frame, hinges = record.world, record.frame, record.mechanism.hinges
    return np.stack([joint_turns(joint, world, frame) for joint in hinges], axis=-1)


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
