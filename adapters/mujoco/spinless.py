"""Rods without spin where that says all, with it where a trajectory needs it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.spin import STILL, spin_about
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Readback, Run

_BENT = 1.0
"""Cardan joints lock at a right angle; near it their rates are large, and so are errors [rad]."""


class Bending(Run):
    """A run of a model with Cardan joints."""

    @abstractmethod
    def simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        """Roll out; tell too how far Cardan joints were bent at frames [rad], (trajectory,)."""

    def rollout(self, batch: Batch) -> Trajectory:
        return self.simulate(batch)[0]


class SpinlessRun(Run):
    """Simulates without spin first, and again with it what spins or bends too far.

    Args:
        mechanism: Of the scene.
        idle: Axes of the rods that have no spin, as `mbds_xsim.scene.spin.idle_axes` gives them.
        spinless: The model without.
        load: Loads the model with spin.
    """

    def __init__(
        self, mechanism: Mechanism, idle: Array, spinless: Bending, load: Callable[[], Run]
    ) -> None:
        self._mechanism, self._idle = mechanism, idle
        self._spinless, self._load = spinless, load
        self._whole: Run | None = None
        self.size = spinless.size

    def rollout(self, batch: Batch) -> Trajectory:
        motion, bend = self._spinless.simulate(batch)
        # Written so that what is not a number is tried again, too.
        again = np.flatnonzero(~(self._still(batch) & (bend <= _BENT)))
        if not len(again):
            return motion
        self._whole = self._whole or self._load()
        return motion.replaced(again, self._whole.rollout(batch[again]))

    def _still(self, batch: Batch) -> Mask:
        """Whether no idle rod of a trajectory spins at its start."""
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
