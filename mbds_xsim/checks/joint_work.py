"""Work that dry friction and servos with limits do on joints within steps.

Between two frames a coordinate goes by the cubic that meets places and rates at both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.coordinates import coordinate_of
from mbds_xsim.checks.finding import Record
from mbds_xsim.scene.joint_space import joint_rate
from mbds_xsim.scene.mechanism import PlacedJoint
from mbds_xsim.scene.servo import PlacedDrive

_POINTS = (16, 8)  # in a step, of the work of a servo; fewer tell how well it is known


class Way(NamedTuple):
    """Coefficients of the cubics, by the share of the step that is over, (trajectory, step)."""

    start: Array
    begin: Array
    bend: Array
    twist: Array

    @staticmethod
    def of(record: Record, joint: PlacedJoint) -> Way:
        """Find those of a hinge or slider."""
        place = coordinate_of(record, joint)
        moved, rate = np.diff(place, axis=1), record.frame * joint_rate(joint, record.world)
        begin, end = rate[:, :-1], rate[:, 1:]
        return Way(place[:, :-1], begin, 3 * moved - 2 * begin - end, begin + end - 2 * moved)

    def moved(self, share: Array | float) -> Array:
        """Give how far it has moved [rad or m]."""
        return np.asarray(share * (self.begin + share * (self.bend + share * self.twist)))

    def rate(self, share: float) -> Array:
        """Give its rate per step."""
        return np.asarray(self.begin + share * (2 * self.bend + 3 * share * self.twist))


def friction_loss(record: Record) -> tuple[Array, Array]:
    """Energy taken by dry friction [J], (trajectory, frame), and its error, (trajectory,).

    In a step in which a joint turns back all of the way there and back is left open.
    """
    loss, vague = np.zeros(record.finite.shape), np.zeros(len(record.finite))
    for joint in record.mechanism.frictional:
        path = Way.of(record, joint)
        root = np.sqrt(np.maximum(path.bend**2 - 3 * path.begin * path.twist, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            # Both are exact where the cubic is nearly a parabola.
            last = -path.bend - np.where(path.bend < 0.0, -root, root)
            turns = np.nan_to_num([last / (3 * path.twist), path.begin / last])
        turns = np.sort(np.clip(turns, 0.0, 1.0), axis=0)
        whole = path.moved(1.0)
        way = np.abs(np.diff([0.0 * whole, *path.moved(turns), whole], axis=0)).sum(axis=0)
        loss[:, 1:] += joint.friction * np.cumsum(way, axis=1)
        vague += joint.friction * np.nansum(way - np.abs(whole), axis=1)
    return loss, vague


def drive_loss(record: Record) -> tuple[Array, Array]:
    """Energy taken by drives [J], (trajectory, frame), and its error, (trajectory,).

    Their work is that of the effort over the way, by Gauß' rule within each step; the error is its
    change with half the points, which is what a kink of the effort leaves.
    """
    loss, vague = np.zeros(record.finite.shape), np.zeros(len(record.finite))
    for k, drive in enumerate(record.mechanism.drives, len(record.mechanism.hinges)):
        push, path = record.torque[:, : record.steps, k], Way.of(record, drive.joint)
        fine, coarse = (_work(drive, push, path, record.frame, count) for count in _POINTS)
        loss[:, 1:] -= np.cumsum(fine, axis=1)
        vague += np.nansum(np.abs(fine - coarse), axis=1)
    return loss, vague


def _work(drive: PlacedDrive, push: Array, path: Way, frame: float, count: int) -> Array:
    places, weights = np.polynomial.legendre.leggauss(count)
    work = np.zeros_like(push)
    for share, weight in zip(0.5 * (places + 1.0), 0.5 * weights, strict=True):
        rate = path.rate(share)
        effort = drive.effort(push, path.start + path.moved(share), rate / frame)
        work += weight * effort * rate
    return work
