"""Effects of forces on velocities within frames, where frames are too far apart to show them.

Between two frames, a light link that whips round or a joint that falls back on its stop has
velocities that differences of recorded ones do not show. The equations of motion at both ends do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.mismatch import MOMENT, Flow, winding_torque
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import BodyStates, joint_rate


@dataclass(frozen=True, eq=False)
class Forced:
    """Measures of the motion within steps, from the accelerations at both ends."""

    places: Array
    """Differences of linear accelerations between both ends, times the frame interval [m/s], shape
    (trajectory, step, body)."""
    turns: Array
    """The same for angular accelerations [rad/s]."""
    pull: Array
    """Accelerations that joints with limits would have without stops, the larger size of both ends
    [rad/s² or m/s²], shape (trajectory, step, joint)."""


def forced(record: Record) -> Forced:
    """Evaluate the equations of motion without contact at both ends of steps; 0 if not finite."""
    lost = ~record.finite[..., None, None]
    bodies = record.bodies.each(lambda values: np.where(lost, values[:, :1], values))
    torque = record.torque[:, : record.steps]
    spring_torque = winding_torque(record.mechanism, bodies)
    begin, end = (
        _accelerations(record, bodies[:, part], torque + spring_torque[:, part])
        for part in (slice(-1), slice(1, None))
    )
    places, turns = (
        record.frame * rotation.norm(a - b) for a, b in zip(begin[:2], end[:2], strict=True)
    )
    pull = np.maximum(np.abs(begin[2]), np.abs(end[2]))
    return Forced(*(np.where(np.isfinite(each), each, 0.0) for each in (places, turns, pull)))


def _accelerations(record: Record, states: BodyStates, torque: Array) -> tuple[Array, Array, Array]:
    """Return linear and angular accelerations of bodies, and those of joints with limits."""
    flow = Flow(record.mechanism, MOMENT * record.frame)
    closed = flow.closed(states)
    pull, push = flow.accelerations(closed, record.force, torque)
    here, then = (each.with_world() for each in (closed, flow.later(closed, pull, push)))
    rates = np.zeros((*pull.shape[:2], len(record.mechanism.limited)))
    for k, joint in enumerate(record.mechanism.limited):
        rates[..., k] = (joint_rate(joint, then) - joint_rate(joint, here)) / flow.moment
    return pull, push, rates
