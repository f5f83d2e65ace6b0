"""Turns count as well as lengths: a micrometre-sized part that turns wrongly moves little."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.checks.agreement import particle_error
from mbds_xsim.dataset.gate import sample_findings
from mbds_xsim.measure.campaign import RTOL
from mbds_xsim.measure.judge import error_findings, turn_finding
from mbds_xsim.measure.outcome import ReferenceOutcome
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene

_GRAIN = 1e-6  # [m]


@pytest.mark.parametrize(
    ("frame", "judged"), [(0.4, 2), (0.5, 2), (0.6, 2), (1.0, 1), (1.25, 1), (3.0, 1)]
)
def test_the_error_at_1_s_is_never_that_of_the_start(frame: float, judged: int) -> None:
    scene = Scene("ball", (Body("ball", inertia=Inertia(1.0, (0.1, 0.1, 0.1))),), length=1.0)
    scene = msgspec.structs.replace(scene, clock=Clock(frame, 3))
    batch = draw_batch(scene, [0])
    truth = reference.solve(scene, batch)

    finding, _ = error_findings(scene, batch, np.array([[0.0, 1, 2, 3]]), truth, np.ones((1, 4)))

    assert (finding.check, finding.figure.tolist()) == ("error at 1 s", [judged])


def test_a_tiny_part_that_turns_wrong_fails_though_nothing_is_far_off() -> None:
    arm = Body("arm", inertia=Inertia(1.0, (0.1, 0.1, 0.1)), position=(0.5, 0.0, 0.0))
    moment = 1e-9 * _GRAIN**2
    grain = Body("grain", inertia=Inertia(1e-9, (moment,) * 3), position=(1.0 + _GRAIN, 0.0, 0.0))
    y = (0.0, 1.0, 0.0)
    joints = (
        Joint("pin", "hinge", "world", "arm", (0.0, 0.0, 0.0), y),
        Joint("tip", "hinge", "arm", "grain", (1.0, 0.0, 0.0), y, rate=1.0),
    )
    scene = Scene("grain", (arm, grain), length=1.0, joints=joints, clock=Clock(1e-3, 20))
    batch = draw_batch(scene, [0])
    truth, growth = reference.solve(scene, batch), np.ones((1, 21))
    turned = truth.orientation.copy()
    wrong = rotation.from_vector(np.array([0.0, 0.32, 0.0]))
    turned[:, 10:, 1] = rotation.multiply(wrong, turned[:, 10:, 1])
    motion = dataclasses.replace(truth, orientation=turned)

    error = particle_error(Mechanism.of(scene), motion, truth)
    lengths = error_findings(scene, batch, error, truth, growth)
    turns = turn_finding(scene, motion.orientation, truth, growth)

    assert all(finding.passed.all() for finding in lengths)
    assert not turns.passed.any()
    assert abs(turns.figure[0] - 0.32) < 1e-9
    assert turns.where == ("grain",)
    assert turn_finding(scene, truth.orientation, truth, growth).figure[0] < 1e-7
    solved = ReferenceOutcome(truth, growth, RTOL, 0, 0.0)
    (published,) = (f for f in sample_findings(scene, batch, motion, solved) if not f.passed.all())
    assert published.check == "error of turns"
    growth[:, 10:] = 200.0  # chaos, which is not judged
    assert turn_finding(scene, motion.orientation, truth, growth).figure[0] < 1e-7
