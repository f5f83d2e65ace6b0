"""Kernels of the checks, compiled before the workers of a data set need them."""

from __future__ import annotations

import numpy as np

from mbds_xsim.checks.audit import audited
from mbds_xsim.checks.record import Record
from mbds_xsim.reference.kernels import Kernels
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.scene.state import STATES, Trajectory

_STEPS = 10


def _check_once() -> None:
    """Run all checks on a body that hangs still, which compiles their kernels."""
    scene = Scene(
        name="bob",
        length=1.0,
        clock=Clock(steps=_STEPS),
        bodies=(Body("bob", position=(0.0, 0.0, -0.5), inertia=Inertia(1.0, (0.1, 0.1, 0.1))),),
        joints=(Joint("nail", "ball", "world", "bob", (0.0, 0.0, 0.0)),),
    )
    batch = draw_batch(scene, range(1))
    still = {key: np.repeat(getattr(batch, key)[:, None], _STEPS + 1, axis=1) for key in STATES}
    time = scene.clock.frame * np.arange(_STEPS + 1.0)
    audited(Record(scene, batch, Trajectory(time, **still, failures=(None,)), many=True))


CHECKS = Kernels("checks", _check_once, 10)
"""Kernels for the checks of many trajectories."""
