"""Springs, dampers and rotors of joints in the balances of energy and momentum."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim.checks import Record
from mbds_xsim.checks.balances import balances_of
from mbds_xsim.checks.conservation import energy_balance, energy_of
from mbds_xsim.checks.coordinates import coordinate_of
from mbds_xsim.checks.finding import Check
from mbds_xsim.checks.integrity import angle_gap, gap
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.testing import Case
from mbds_xsim.testing.joint_cases import JOINT_CASES


def _record(scene: Scene) -> Record:
    batch = draw_batch(scene, [0])
    return Record(scene, batch, solve(scene, batch, cache=False))


_LED = ("servo", "led block")


@pytest.mark.parametrize("name", _LED)
def test_a_servo_balances_as_far_as_the_work_of_its_damper_is_known(name: str) -> None:
    (case,) = (case for case in JOINT_CASES if case.name == name)
    finding = energy_balance.finding(_record(case.scene))

    assert finding.uncertainty is not None
    assert finding.figure.max() < finding.uncertainty.max() < 0.01


_LAWS = [case for case in JOINT_CASES if case.name not in _LED]


@pytest.mark.parametrize("case", _LAWS, ids=lambda case: case.name)
def test_the_exact_motion_balances_and_one_with_another_law_does_not(case: Case) -> None:
    record = _record(case.scene)

    finding = energy_balance.finding(record)
    assert finding.uncertainty is not None
    # Dry friction may stop a joint inside a frame, and of its work there no more is known.
    stops = finding.uncertainty.max() if record.mechanism.frictional else 0.0
    assert finding.figure.max() < max(1e-5, stops)
    given = (key for joint in case.scene.joints for key in joint.added if getattr(joint, key))
    for key in {*given} - {"rest"}:
        joints = (
            msgspec.structs.replace(joint, **{key: 1.05 * getattr(joint, key)})
            for joint in case.scene.joints
        )
        other = msgspec.structs.replace(case.scene, joints=tuple(joints))
        wrong = Record(other, record.batch, record.trajectory)
        assert energy_balance.finding(wrong).figure.max() > 1e-3


@pytest.mark.parametrize(
    ("name", "seen"), [("planetary gear", angle_gap), ("rack and pinion", gap)]
)
def test_a_gear_keeps_its_ratio_and_one_of_another_ratio_does_not(name: str, seen: Check) -> None:
    (case,) = (case for case in JOINT_CASES if case.name == name)
    record = _record(case.scene)
    ties = (msgspec.structs.replace(tie, ratio=1.05 * tie.ratio) for tie in case.scene.couplings)
    wrong = msgspec.structs.replace(case.scene, couplings=tuple(ties))

    assert seen.finding(record).figure.max() < 1e-9
    assert seen.finding(Record(wrong, record.batch, record.trajectory)).figure.max() > 1e-3


def test_a_spring_stores_what_whole_turns_put_into_it() -> None:
    (case,) = (case for case in JOINT_CASES if case.name == "sprung hinge")
    record = _record(case.scene)
    (axle,) = record.mechanism.compliant

    angle = coordinate_of(record, axle)

    assert angle.max() > np.pi
    energy, stored = energy_of(record), 0.5 * axle.stiffness * (angle - axle.rest) ** 2
    assert energy.potential == pytest.approx(stored)


def test_a_joint_to_the_world_with_a_load_takes_momentum() -> None:
    for case in JOINT_CASES:
        mechanism = Mechanism.of(case.scene)
        held = any(
            -1 in (joint.parent, joint.child) and joint.is_loaded for joint in mechanism.joints
        )

        assert bool(balances_of(mechanism)) is not held
