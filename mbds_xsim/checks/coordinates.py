"""Coordinates of joints over a recorded motion, and their rates."""

from __future__ import annotations

import functools

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.clearance import counted_coordinate
from mbds_xsim.checks.finding import Record
from mbds_xsim.scene.joint_space import joint_rate, joint_turns
from mbds_xsim.scene.mechanism import PlacedJoint


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
