"""Energy that dampers, dry friction and servos with limits take within steps.

Between two frames a coordinate goes by the cubic that meets places and rates at both.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.coordinates import coordinate_of
from mbds_xsim.checks.integrity import pair_distance, pair_rate
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import joint_rate
from mbds_xsim.scene.mechanism import PlacedJoint, PointPair
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
        rate = joint_rate(joint, record.world)
        return Way.through(coordinate_of(record, joint), record.frame * rate)

    @staticmethod
    def through(place: Array, rate: Array) -> Way:
        """Find those that meet places and rates per step, (trajectory, frame)."""
        moved, begin, end = np.diff(place, axis=1), rate[:, :-1], rate[:, 1:]
        return Way(place[:, :-1], begin, 3 * moved - 2 * begin - end, begin + end - 2 * moved)

    def moved(self, share: Array | float) -> Array:
        """Give how far it has moved [rad or m]."""
        return np.asarray(share * (self.begin + share * (self.bend + share * self.twist)))

    def rate(self, share: float) -> Array:
        """Give its rate per step."""
        return np.asarray(self.begin + share * (2 * self.bend + 3 * share * self.twist))

    @property
    def square(self) -> Array:
        """Mean square of its rate: of its mean, its change and its bend, which do not mix."""
        change = 2 * self.bend + 3 * self.twist
        return np.asarray(self.moved(1.0) ** 2 + change**2 / 12 + self.twist**2 / 20)

    @property
    def vague(self) -> Array:
        """How well that is known: (mean of both ends − mean rate)², of a smooth motion 2.5 times
        the error, and twice of a rate that is gone long before the step ends."""
        return 0.25 * self.twist**2


@functools.lru_cache(maxsize=1)
def losses(record: Record) -> tuple[Array, Array]:
    """Give the energy taken up to each frame [J], (trajectory, frame), and each step's error.

    The errors have the shape (trajectory, step); what drives give counts as taken, negative.
    """
    shape = len(record.finite), record.steps
    taken, vague = np.zeros(shape), np.zeros(shape)
    for loss, error in (*_dampers(record), *_friction(record), *_drives(record)):
        taken, vague = taken + loss, vague + error
    return np.pad(np.cumsum(taken, axis=1), ((0, 0), (1, 0))), np.nan_to_num(vague)


Taken = Iterator[tuple[Array, Array]]
"""Energies that are taken in each step, and their errors [J], (trajectory, step)."""


def _ways(record: Record) -> Iterator[tuple[PointPair | PlacedJoint, Way]]:
    """Springs and joints with springs or dampers, and how they go."""
    world = record.world
    for spring in record.mechanism.springs:
        place, rate = (find(world, (spring,))[..., 0] for find in (pair_distance, pair_rate))
        yield spring, Way.through(place, record.frame * rate)
    for joint in record.mechanism.compliant:
        yield joint, Way.of(record, joint)


def _dampers(record: Record) -> Taken:
    """Of springs and of joints: damping times the integral of the rate's square."""
    for each, path in _ways(record):
        if each.damping:
            yield (
                each.damping / record.frame * path.square,
                each.damping / record.frame * path.vague,
            )


def delayed_springs(record: Record) -> Array:
    """What springs lose for each second that they act late [J/s], (trajectory, step).

    It is a damper of the stiffness times the delay. Methods of first order take places and rates at
    other instants.
    """
    lost = np.zeros((len(record.finite), record.steps))
    for each, path in _ways(record):
        lost += each.stiffness / record.frame * path.square
    return lost


def _friction(record: Record) -> Taken:
    """Dry: in a step in which a joint turns back all of the way there and back is left open.

    There it goes no farther than at the smaller rate of the step's ends in half the step.
    """
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
        ends = path.begin, path.rate(1.0)
        back = np.where(ends[0] * ends[1] < 0.0, np.abs(ends).min(axis=0), 0.0)
        yield joint.friction * way, joint.friction * np.maximum(way - np.abs(whole), back)


def _drives(record: Record) -> Taken:
    """By the effort over the way, with Gauß' rule.

    The error is that of their dampers, and the change with half the points, which is what a kink of
    the effort leaves.
    """
    for k, drive in enumerate(record.mechanism.drives, len(record.mechanism.hinges)):
        push, path = record.torque[:, : record.steps, k], Way.of(record, drive.joint)
        fine, coarse = (_work(drive, push, path, record.frame, count) for count in _POINTS)
        yield -fine, np.abs(fine - coarse) + drive.servo.damping / record.frame * path.vague


def _work(drive: PlacedDrive, push: Array, path: Way, frame: float, count: int) -> Array:
    places, weights = np.polynomial.legendre.leggauss(count)
    work = np.zeros_like(push)
    for share, weight in zip(0.5 * (places + 1.0), 0.5 * weights, strict=True):
        rate = path.rate(share)
        effort = drive.effort(push, path.start + path.moved(share), rate / frame)
        work += weight * effort * rate
    return work
