"""Input and output of a simulation, and the fingerprint of a scene's physics.

Axes are (trajectory, frame, body, component). Bodies are in scene order. Orientations turn
published body frames to W (wxyz); velocities are of the centres of mass, all in W.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array, Index, Mask, Picked
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.scene.sampling_terms import INTERVALS, Interval, Levels
from mbds_xsim.scene.scene import Inertia, Scene

STATES = ("position", "orientation", "velocity", "angular_velocity")
"""Fields that give the state of a body in a frame or at its start."""


@dataclass(frozen=True, eq=False)
class Batch(Picked):
    """Starts and inputs of some trajectories."""

    index: Index
    """Number of each trajectory, which decides its interval and random numbers; (trajectory,)."""
    position: Array
    """Centres of mass at frame 0 [m], shape (trajectory, body, 3)."""
    orientation: Array
    """Orientations at frame 0, shape (trajectory, body, 4)."""
    velocity: Array
    """Velocities of the centres of mass at frame 0 [m/s], shape (trajectory, body, 3)."""
    angular_velocity: Array
    """Angular velocities in W at frame 0 [rad/s], shape (trajectory, body, 3)."""
    force: Array
    """Forces in W on centres of mass, held over each step [N], (trajectory, step, body, 3)."""
    torque: Array
    """Torques about `Mechanism.hinges`, held over each step [N·m], shape (trajectory, step, hinge).
    They act on the child and oppositely on the parent; the axis turns with the bodies."""

    def __len__(self) -> int:
        return len(self.index)

    def interval(self, row: int) -> Interval:
        """Return the sampling interval of a row."""
        return INTERVALS[int(self.index[row]) % len(INTERVALS)]

    @property
    def regular(self) -> Mask:
        """Whether each row is of the low or medium interval, judged at 1 s."""
        return self.index % len(INTERVALS) != INTERVALS.index("high")

    def label(self, row: int) -> str:
        """Return a readable name of a row, with its interval unless the row is the only one."""
        interval = f" ({self.interval(row)})" if len(self) > 1 else ""
        return f"trajectory {self.index[row]}{interval}"

    def truncated(self, steps: int) -> Batch:
        """Keep the inputs of the first steps only."""
        return dataclasses.replace(self, force=self.force[:, :steps], torque=self.torque[:, :steps])

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return self.force.shape[1]


@dataclass(frozen=True)
class Failure:
    """Early end of a trajectory; a value, not an exception."""

    frame: int
    """First missing frame."""
    reason: str


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Recorded motion of a batch. Frames from a failure on are NaN."""

    time: Array
    """Times of the frames [s], shape (frame,)."""
    position: Array
    """Centres of mass [m], shape (trajectory, frame, body, 3)."""
    orientation: Array
    """Orientations, shape (trajectory, frame, body, 4)."""
    velocity: Array
    """Velocities of the centres of mass [m/s], shape (trajectory, frame, body, 3)."""
    angular_velocity: Array
    """Angular velocities in W [rad/s], shape (trajectory, frame, body, 3)."""
    failures: tuple[Failure | None, ...]
    """One entry per trajectory; None if it ran to the end."""

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: slice | list[int] | Mask) -> Trajectory:
        """Select some of the trajectories."""
        arrays = {key: getattr(self, key)[rows] for key in STATES}
        failures = tuple(self.failures[row] for row in np.arange(len(self))[rows])
        return dataclasses.replace(self, **arrays, failures=failures)

    def replaced(self, rows: Index, other: Trajectory) -> Trajectory:
        """Replace some of the trajectories by those of another, in order."""
        arrays = {key: getattr(self, key).copy() for key in STATES}
        failures = list(self.failures)
        for key, values in arrays.items():
            values[rows] = getattr(other, key)
        for row, failure in zip(rows, other.failures, strict=True):
            failures[row] = failure
        return Trajectory(self.time, **arrays, failures=tuple(failures))

    def padded(self, time: Array) -> Trajectory:
        """Extend with frames of NaN, as after a failure, to the end of the given times."""
        whole = Trajectory.empty(time, len(self), self.position.shape[2])
        for key in STATES:
            getattr(whole, key)[:, : len(self.time)] = getattr(self, key)
        return dataclasses.replace(whole, failures=self.failures)

    @property
    def known(self) -> Mask:
        """Whether the motion is known at a frame, shape (trajectory, frame)."""
        return np.asarray(np.isfinite(self.position).all(axis=(2, 3)))

    @property
    def finite(self) -> Mask:
        """Whether all numbers of a trajectory are finite, shape (trajectory,)."""
        fields = [getattr(self, key) for key in STATES]
        with np.errstate(over="ignore", invalid="ignore"):
            if all(np.isfinite(field.sum()) for field in fields):  # the usual case
                return np.ones(len(self), dtype=bool)
        return np.logical_and.reduce([np.isfinite(field).all(axis=(1, 2, 3)) for field in fields])

    def cut_at_failures(self) -> Trajectory:
        """Set all frames from each failure on, at least the last one, to NaN.

        This keeps numbers that an adapter left there from being used.
        """
        last = len(self.time) - 1
        for row, failure in enumerate(self.failures):
            if failure is not None:
                for key in STATES:
                    getattr(self, key)[row, min(max(failure.frame, 0), last) :] = np.nan
        return self

    @staticmethod
    def joined(parts: Sequence[Trajectory]) -> Trajectory:
        """Concatenate the trajectories of one or more parts."""
        if len(parts) == 1:
            return parts[0]
        arrays = {key: np.concatenate([getattr(part, key) for part in parts]) for key in STATES}
        failures = tuple(failure for part in parts for failure in part.failures)
        return Trajectory(parts[0].time, **arrays, failures=failures)

    @staticmethod
    def empty(
        time: Array, trajectory_count: int, body_count: int, failure: Failure | None = None
    ) -> Trajectory:
        """Make a trajectory of NaN, for a run to fill in, or one that failed as a whole."""
        shape = (trajectory_count, len(time), body_count)
        place, turn, speed, spin = (np.full((*shape, size), np.nan) for size in (3, 4, 3, 3))
        return Trajectory(time, place, turn, speed, spin, (failure,) * trajectory_count)


_INERT = ("name", "description", "source", "budget", "anchors", "edges")
"""Fields of a scene that do not affect the motion."""
_SMALL, _LEAST = 1e-6, 1e-60
"""Sizes of numbers of which 15 decimals keep nine digits, and of the smallest moment."""
_OWN = (
    "mass", "inertia", "moments", "stiffness", "damping", "friction", "armature", "limit", "noise",
)  # fmt: skip
"""Keys of numbers that affect the motion however small they are."""
_SHARED = ("series", "torque", "mean")
"""Keys of loads: small ones next to larger ones are rounding errors."""


def fingerprint(scene: Scene) -> str:
    """Return 16 hexadecimal digits that identify bodies, joints, loads, clock and starts.

    Numbers are rounded to nine digits, so that a scene made by a formula has the same
    fingerprint on every machine.
    """
    items = scene.decisive().items()
    plain = {key: _plain(value, _size(scene, key)) for key, value in items if key not in _INERT}
    return hashlib.sha256(msgspec.json.encode(plain, order="sorted")).hexdigest()[:16]


def _plain(value: Any, size: float) -> Any:
    """Write out tables including defaults, since these also affect the motion.

    Numbers keep nine digits of a size, or of their own if that is 0, and at least 15 decimals.
    """
    if isinstance(value, Neutral):
        parts = {
            key: _plain(part, size if isinstance(value, Levels) else _size(value, key))
            for key, part in value.decisive().items()
        }
        return [type(value).__name__, parts]
    if isinstance(value, list | tuple):
        return [_plain(part, size) for part in value]
    if value is None or isinstance(value, str | bool):
        return value
    number = float(value)
    size = size or abs(number)
    decimals = 8 - math.floor(math.log10(size)) if _LEAST <= size < _SMALL else 15
    return f"{round(number, decimals) + 0.0:.9g}"


def _size(table: Neutral, key: str) -> float:
    """Return the size of which nine digits of a table's numbers matter; 0 for that of each."""
    if isinstance(table, Inertia) and key == "products":
        return max(table.moments)
    if key in _SHARED:
        return _largest(getattr(table, key))
    return 0.0 if key in _OWN else 1.0


def _largest(value: Any) -> float:
    parts = value.decisive().values() if isinstance(value, Levels) else value
    return abs(parts) if isinstance(parts, int | float) else max(map(_largest, parts))
