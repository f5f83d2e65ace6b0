"""Kernels of the checks, compiled before the workers of a data set need them."""

from __future__ import annotations

import numpy as np

from mbds_xsim.checks.audit import audited
from mbds_xsim.checks.record import Record
from mbds_xsim.reference.kernels import BOB, Kernels
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.state import STATES, Trajectory


def _check_once() -> None:
    """Run all checks on a body that hangs still, which compiles their kernels."""
    batch, frames = draw_batch(BOB, range(1)), BOB.clock.steps + 1
    still = {key: np.repeat(getattr(batch, key)[:, None], frames, axis=1) for key in STATES}
    time = BOB.clock.frame * np.arange(float(frames))
    audited(Record(BOB, batch, Trajectory(time, **still, failures=(None,)), many=True))


CHECKS = Kernels("checks", _check_once, 10)
"""Kernels for the checks of many trajectories."""
