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
from mbds_xsim.checks.joint_work import Way
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.testing import Case
from mbds_xsim.testing.joint_cases import JOINT_CASES


def _record(scene: Scene) -> Record:
    batch = draw_batch(scene, [0])
    return Record(scene, batch, solve(scene, batch, cache=False))


@pytest.mark.parametrize("pace", [3.0, 30.0])
def test_what_a_damper_takes_of_a_swing_is_found_by_order_4(pace: float) -> None:
    def off(steps: int) -> tuple[float, float]:
        time = np.linspace(0.0, 1.0, steps + 1)[None]
        path = Way.through(np.sin(pace * time), pace / steps * np.cos(pace * time))
        exact = pace**2 * (0.5 + np.sin(2 * pace) / (4 * pace))
        return abs(steps * path.square.sum() - exact), steps * path.vague.sum()

    (coarse, vague), (fine, less) = off(40), off(80)

    assert coarse / fine == pytest.approx(16.0, rel=0.1)
    assert 1.0 < vague / coarse < 4.0
    assert 1.0 < less / fine < 4.0


@pytest.mark.parametrize("stretch", [1e-3, 0.1, 0.3, 1.0])
def test_of_a_joint_that_a_damper_stops_within_a_frame_it_is_known_that_little_is_known(
    stretch: float,
) -> None:
    place = stretch * -np.expm1(-np.arange(2) / stretch)[None]
    path = Way.through(place, np.exp(-np.arange(2) / stretch)[None])

    exact = -0.5 * stretch * np.expm1(-2 / stretch)

    assert abs(path.square - exact) < path.vague


@pytest.mark.parametrize("case", JOINT_CASES, ids=lambda case: case.name)
def test_the_exact_motion_balances_and_one_with_another_law_does_not(case: Case) -> None:
    record = _record(case.scene)

    finding = energy_balance.finding(record)
    assert finding.uncertainty is not None
    # Dry friction may stop a joint within a frame, in which its work is not known better.
    stops = finding.uncertainty.max() if record.mechanism.frictional else 0.0
    assert finding.figure.max() < max(1e-5, stops)
    # 5 % of the led block's stiffness are 8.4e-4 of its scale of energy.
    least = 5e-4 if case.name == "led block" else 1e-3
    laws = (key for joint in case.scene.joints for key in joint.added if getattr(joint, key))
    for key in {*laws} - {"rest"}:
        joints = (
            msgspec.structs.replace(joint, **{key: 1.05 * getattr(joint, key)})
            for joint in case.scene.joints
        )
        other = msgspec.structs.replace(case.scene, joints=tuple(joints))
        wrong = Record(other, record.batch, record.trajectory)
        assert energy_balance.finding(wrong).figure.max() > least


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
        loaded = any(
            -1 in (joint.parent, joint.child) and joint.is_loaded for joint in mechanism.joints
        )

        assert bool(balances_of(mechanism)) is not loaded
