"""Energy that dampers, dry friction and drives take within steps.

Between two frames a coordinate follows the cubic that matches places and rates at both.
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

_POINTS = (16, 8)  # Gauß points per step for the work of a drive; the fewer give the error


class Way(NamedTuple):
    """Coefficients of cubics in the elapsed share of a step, shape (trajectory, step)."""

    start: Array
    begin: Array
    bend: Array
    twist: Array

    @staticmethod
    def of(record: Record, joint: PlacedJoint) -> Way:
        """Return the cubics of a hinge or slider."""
        rate = joint_rate(joint, record.world)
        return Way.through(coordinate_of(record, joint), record.frame * rate)

    @staticmethod
    def through(place: Array, rate: Array) -> Way:
        """Return the cubics that match places and rates per step, (trajectory, frame)."""
        moved, begin, end = np.diff(place, axis=1), rate[:, :-1], rate[:, 1:]
        return Way(place[:, :-1], begin, 3 * moved - 2 * begin - end, begin + end - 2 * moved)

    def moved(self, share: Array | float) -> Array:
        """Return the way since the step began [rad or m]."""
        return np.asarray(share * (self.begin + share * (self.bend + share * self.twist)))

    def rate(self, share: float) -> Array:
        """Return the rate per step."""
        return np.asarray(self.begin + share * (2 * self.bend + 3 * share * self.twist))

    @property
    def square(self) -> Array:
        """Mean square of the rate, from its orthogonal parts: mean, change and bend."""
        change = 2 * self.bend + 3 * self.twist
        return np.asarray(self.moved(1.0) ** 2 + change**2 / 12 + self.twist**2 / 20)

    @property
    def vague(self) -> Array:
        """Error bound of `square`: (mean of both ends − mean rate)². It is 2.5 times the error of
        a smooth motion, and twice that of a rate that dies out long before the step ends."""
        return 0.25 * self.twist**2


@functools.lru_cache(maxsize=1)
def losses(record: Record) -> tuple[Array, Array]:
    """Return the energy taken up to each frame [J], (trajectory, frame), and each step's error.

    The errors have the shape (trajectory, step). Energy that drives supply counts as negative.
    """
    shape = len(record.finite), record.steps
    energy, uncertainty = np.zeros(shape), np.zeros(shape)
    for loss, error in (*_dampers(record), *_friction(record), *_drives(record)):
        energy, uncertainty = energy + loss, uncertainty + error
    return np.pad(np.cumsum(energy, axis=1), ((0, 0), (1, 0))), np.nan_to_num(uncertainty)


Losses = Iterator[tuple[Array, Array]]
"""Energies taken in each step, and their errors [J], (trajectory, step)."""


def _ways(record: Record) -> Iterator[tuple[PointPair | PlacedJoint, Way]]:
    """Yield springs, and joints with springs or dampers, with their cubics."""
    world = record.world
    for spring in record.mechanism.springs:
        place, rate = (measure(world, (spring,))[..., 0] for measure in (pair_distance, pair_rate))
        yield spring, Way.through(place, record.frame * rate)
    for joint in record.mechanism.compliant:
        yield joint, Way.of(record, joint)


def _dampers(record: Record) -> Losses:
    """Yield the losses of dampers: damping times the integral of the squared rate."""
    for each, path in _ways(record):
        if each.damping:
            drag = each.damping / record.frame
            yield drag * path.square, drag * path.vague


def delayed_springs(record: Record) -> Array:
    """Compute the energy that springs take per second of time shift [J/s], (trajectory, step).

    A time shift acts like a damper of the stiffness times the shift. Methods of first order have
    one, as they take places and rates at different instants.
    """
    loss = np.zeros((len(record.finite), record.steps))
    for each, path in _ways(record):
        loss += each.stiffness / record.frame * path.square
    return loss


def _friction(record: Record) -> Losses:
    """Yield losses of dry friction; if a joint turns back, its way there and back is the error.

    If the rates at the step's two ends differ in sign, that way is at least the smaller rate times
    the step.
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


def _drives(record: Record) -> Losses:
    """Yield minus the work of drives: the effort integrated over the way by Gauß' rule.

    The error is that of their dampers plus the change with half the points, which a kink of the
    effort causes.
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
