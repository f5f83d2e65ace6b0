"""Runs that agree on the instant of an impact, which is known to a step alone."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from mbds_xsim.checks import Finding
from mbds_xsim.checks.consistency import Consistency
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.scene.state import STATES, Failure, Trajectory
from mbds_xsim.simulate.claims import Method

_EULER = Method("Euler", "semi-implicit Euler", 1)


def _wheel(stop: float) -> tuple[Any, ...]:
    """Return a wheel that turns freely at 1 rad/s until its stop, its start and its motion."""
    origin, axis = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    pin = Joint("pin", "hinge", "world", "wheel", origin, axis, rate=1.0, limits=(-1.0, stop))
    wheel = Body("wheel", inertia=Inertia(1.0, (0.1, 0.1, 0.1), com=(0.5, 0.0, 0.0)))
    scene = Scene("stop", (wheel,), 1.0, joints=(pin,), clock=Clock(0.02, 25))
    batch = draw_batch(scene, [0])
    return scene, batch, solve(scene, batch, cache=False)


def _findings(scene: Scene, batch: Any, off: Trajectory, exact: Any, step: float) -> list[Finding]:
    return Consistency(scene, batch, [off] * 3, exact, _EULER, step=step).findings


def test_runs_that_agree_on_a_wrong_instant_of_an_impact_are_known_to_a_step() -> None:
    """All runs pass the stop by the same part of a step."""
    scene, batch, exact = _wheel(0.307)
    stopped, on = exact.time > 0.307, np.array((0.0, 1.0, 0.0))

    def figure(passed_by: float, step: float) -> float:
        off = dataclasses.replace(
            exact, position=exact.position + passed_by * stopped[None, :, None, None] * on
        )
        return float(_findings(scene, batch, off, exact, step)[0].figure[0])

    assert figure(1e-5, step=2e-5) < 3.0
    assert figure(1e-5, step=0.0) > 100.0
    assert figure(1e-4, step=2e-5) > 3.0


@pytest.mark.parametrize(("frames", "passes"), [(1, True), (2, False)])
def test_a_frame_within_a_step_of_an_impact_may_be_before_or_after_it(
    frames: int, passes: bool
) -> None:
    """The wheel is at its stop 10 µs before frame 15, in all runs just after it."""
    scene, batch, exact = _wheel(0.29999)
    late = slice(15, 15 + frames)
    velocity, spin = exact.velocity.copy(), exact.angular_velocity.copy()
    velocity[:, late], spin[:, late] = velocity[:, 14:15], spin[:, 14:15]
    off = dataclasses.replace(exact, velocity=velocity, angular_velocity=spin)

    _, energies = _findings(scene, batch, off, exact, 2e-5)

    assert (float(energies.figure[0]) <= 3.0) == passes


def test_a_frame_next_to_an_impact_is_unknown_where_runs_have_stopped() -> None:
    """The runs show no order, but differ too little to matter, until they stop at the impact."""
    scene, batch, exact = _wheel(0.307)

    def off_by(error: float) -> Trajectory:
        states = {key: getattr(exact, key) * (1 + error * ("velocity" in key)) for key in STATES}
        stopped = dataclasses.replace(exact, **states, failures=(Failure(16, "a test"),))
        return stopped.cut_at_failures()

    runs = [off_by(error) for error in (1e-6, 0.9e-6, 0.75e-6, 0.55e-6)]
    _, energies = Consistency(scene, batch, runs, exact, _EULER).findings

    assert "differ by less than a thousandth" in energies.note
    assert energies.passed.all()
