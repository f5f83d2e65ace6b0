"""Coordinates of joints over a recorded motion, and their rates."""

from __future__ import annotations

import functools

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.finding import Record
from mbds_xsim.scene.joint_space import joint_coordinate, joint_rate
from mbds_xsim.scene.mechanism import PlacedJoint


@functools.lru_cache(maxsize=1)
def hinge_turns(record: Record) -> Array:
    """Angles by which the hinges turn over each step [rad], shape (trajectory, step, hinge).

    A frame gives a hinge's angle up to full turns; the mean of the hinge rates at the two ends
    of the step chooses among them.
    """
    bodies, rates = record.bodies, hinge_rates(record)
    turns = []
    for k, joint in enumerate(record.mechanism.hinges):
        turn = np.diff(joint_coordinate(joint, bodies.position, bodies.native), axis=1)
        expected = 0.5 * (rates[:, 1:, k] + rates[:, :-1, k]) * record.frame
        turns.append(turn + 2 * np.pi * np.round((expected - turn) / (2 * np.pi)))
    return np.stack(turns, axis=-1)


def coordinate_of(record: Record, joint: PlacedJoint) -> Array:
    """Give a joint's coordinate [rad or m], shape (trajectory, frame).

    A hinge's angle is in (−π, π] at the start, and counts whole turns from then on.
    """
    found = joint_coordinate(joint, record.bodies.position, record.bodies.native)
    if joint.kind == "hinge":
        turns = hinge_turns(record)[..., record.mechanism.hinges.index(joint)].cumsum(axis=1)
        found[:, 1:] = found[:, :1] + turns
    return found


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
