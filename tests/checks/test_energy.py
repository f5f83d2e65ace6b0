from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mbds_xsim.checks import Record
from mbds_xsim.checks.conservation import energy_balance, energy_of, input_work
from mbds_xsim.checks.coordinates import hinge_turns
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene, Torque
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.claims import Method

SECOND_ORDER = Method("midpoint", "trapezoidal", 2)


def test_an_exact_motion_balances(pendulum: Any, tumbling: Any, linkage: Any) -> None:
    for case, limit in ((pendulum, 1e-6), (tumbling, 1e-6), (linkage, 1e-4)):
        finding = energy_balance.finding(Record(case.scene, case.batch, case.exact, SECOND_ORDER))
        assert finding.passed.all()
        assert finding.figure.max() < limit


def test_the_inputs_do_work_that_must_be_counted(pendulum: Any, tumbling: Any) -> None:
    for case in (pendulum, tumbling):
        record = Record(case.scene, case.batch, case.exact)
        energy = energy_of(record)
        uncounted = np.abs(energy.total - energy.total[:, :1]).max(axis=1)
        missing = np.abs(energy.total - energy.total[:, :1] - input_work(record)).max(axis=1)
        assert (missing < 1e-3 * uncounted).all()


def test_a_drift_of_energy_fails_by_the_order_of_the_method(pendulum: Any) -> None:
    growth = np.linspace(1.0, 1.0 + 2e-3, len(pendulum.exact.time))[:, None, None]
    drifting = dataclasses.replace(pendulum.exact, velocity=pendulum.exact.velocity * growth)
    second = energy_balance.finding(Record(pendulum.scene, pendulum.batch, drifting, SECOND_ORDER))
    first = energy_balance.finding(Record(pendulum.scene, pendulum.batch, drifting))
    assert not second.passed.any()
    assert first.passed.all()
    assert first.budget == pendulum.scene.budget.energy_first_order


def test_a_first_order_method_stays_off_by_its_order(
    pendulum: Any, simulate: Callable[..., Trajectory]
) -> None:
    figures = []
    for substeps in (10, 20):
        run = simulate(pendulum.scene, pendulum.batch, substeps, "euler_reduced")
        finding = energy_balance.finding(Record(pendulum.scene, pendulum.batch, run))
        figures.append(finding.figure)
    assert np.allclose(figures[0] / figures[1], 2.0, rtol=0.15)


def _spinner(rate: float) -> Scene:
    return Scene(
        name="spinner",
        gravity=(0.0, 0.0, 0.0),
        bodies=(Body("wheel", inertia=Inertia(1.0, (0.1, 0.1, 0.2))),),
        joints=(Joint("axle", "hinge", "world", "wheel", (0, 0, 0), (0.0, 0.0, 1.0), rate=rate),),
        torques=(Torque("axle", (0.3, -0.2), hold=5),),
        length=0.3,
        clock=Clock(0.1, 10),
    )


@pytest.mark.parametrize("rate", [1.0, 100.0, -250.0])
def test_turns_of_a_fast_wheel_are_unwrapped(rate: float) -> None:
    scene = _spinner(rate)
    batch = draw_batch(scene, [0])
    torque = batch.torque[0, :, 0]
    speed = rate + np.concatenate([[0.0], np.cumsum(torque / 0.2 * 0.1)])
    turns = 0.1 * (speed[:-1] + speed[1:]) / 2
    angle = np.concatenate([[0.0], np.cumsum(turns)])
    orientation = np.zeros((1, 11, 1, 4))
    orientation[0, :, 0, 0], orientation[0, :, 0, 3] = np.cos(angle / 2), np.sin(angle / 2)
    zero, spin = np.zeros((1, 11, 1, 3)), np.zeros((1, 11, 1, 3))
    spin[0, :, 0, 2] = speed
    motion = Trajectory(np.linspace(0.0, 1.0, 11), zero, orientation, zero, spin, (None,))
    record = Record(scene, batch, motion, SECOND_ORDER)
    assert np.allclose(hinge_turns(record)[0, :, 0], turns, atol=1e-9)
    finding = energy_balance.finding(record)
    assert finding.figure[0] < 1e-12
    backwards = dataclasses.replace(batch, torque=-batch.torque)
    wrong = energy_balance.finding(Record(scene, backwards, motion, SECOND_ORDER))
    # Twice the work of the torques goes unexplained.
    assert wrong.figure[0] == pytest.approx(
        2 * np.abs(input_work(record)).max() / energy_of(record).scale[0]
    )


def test_frames_after_a_failure_are_left_out(pendulum: Any) -> None:
    velocity = pendulum.exact.velocity.copy()
    velocity[0, 10:] = np.nan
    velocity[1, 10] = np.inf
    velocity[1, 11:] = 1e200
    broken = dataclasses.replace(pendulum.exact, velocity=velocity)
    finding = energy_balance.finding(Record(pendulum.scene, pendulum.batch, broken))
    assert np.isnan(finding.series[:2, 10:]).all()
    assert finding.passed.all()
