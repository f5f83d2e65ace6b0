"""Runs that leave out the spin of rods, except for trajectories that need it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.spin import STILL, spin_about
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Readback, Run

_LARGEST_BEND = 1.0
"""Largest bend of a Cardan joint [rad]; near a right angle, where it locks, errors are large."""


class Bending(Run):
    """A run of a model with Cardan joints."""

    @abstractmethod
    def simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        """Roll out; also return the largest recorded bend of Cardan joints [rad], (trajectory,)."""

    def rollout(self, batch: Batch) -> Trajectory:
        return self.simulate(batch)[0]


class SpinlessRun(Run):
    """A run without spin that repeats trajectories with spin if they spin or bend too far.

    Args:
        mechanism: Mechanism of the scene.
        idle: Axes of the rods that have no spin, from `mbds_xsim.scene.spin.idle_axes`.
        load: Function that loads the model, without spin if it is given these axes.
    """

    def __init__(self, mechanism: Mechanism, idle: Array, load: Callable[..., Bending]) -> None:
        self._mechanism, self._idle = mechanism, idle
        self._spinless, self._load = load(idle), load
        self._whole: Run | None = None
        self.size = self._spinless.size

    def rollout(self, batch: Batch) -> Trajectory:
        motion, bend = self._spinless.simulate(batch)
        # Written so that NaN is tried again, too.
        rows = np.flatnonzero(~(self._still(batch) & (bend <= _LARGEST_BEND)))
        if not len(rows):
            return motion
        self._whole = self._whole or self._load()
        return motion.replaced(rows, self._whole.rollout(batch[rows]))

    def _still(self, batch: Batch) -> Mask:
        """Return for each trajectory whether no idle rod spins at its start."""
        native = self._mechanism.native_rotation(batch.orientation)
        spin = np.abs(spin_about(self._idle, native, batch.angular_velocity)).max(axis=-1)
        return np.asarray(spin <= STILL)

    def readback(self, batch: Batch) -> Readback:
        return self._spinless.readback(batch)

    def native(self, batch: Batch) -> str:
        if self._still(batch[:1]).all():
            return self._spinless.native(batch)
        self._whole = self._whole or self._load()
        return self._whole.native(batch)

    def close(self) -> None:
        self._spinless.close()
        if self._whole is not None:
            self._whole.close()
