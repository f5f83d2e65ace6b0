"""Servos that saturate: the reference meets closed forms, and energy and laws of a joint hold."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import SceneError
from mbds_xsim.checks import Record
from mbds_xsim.checks.conservation import energy_balance, energy_of
from mbds_xsim.reference.solution import confirmed, solve
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Joint, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.testing import Case
from mbds_xsim.testing.case import NONE, even
from mbds_xsim.testing.limit_cases import SERVO_CASES
from tests.random_scenes import random_tree

_CASES = pytest.mark.parametrize("case", SERVO_CASES, ids=lambda case: case.name)


def _record(scene: Scene) -> Record:
    batch = draw_batch(scene, [0])
    return Record(scene, batch, solve(scene, batch, cache=False))


@_CASES
def test_both_ways_of_solving_meet_the_closed_form_to_1e_9(case: Case) -> None:
    batch = draw_batch(case.scene, [0])

    for motion in (solve(case.scene, batch, cache=False), confirmed(case.scene, batch, False)):
        assert motion.failures == (None,)
        assert np.abs(motion.position[0] - case.exact(motion.time)).max() < 1e-9


@_CASES
def test_the_balance_of_energy_takes_the_saturated_effort(case: Case) -> None:
    record = _record(case.scene)
    finding = energy_balance.finding(record)
    assert finding.figure.max() < 1e-5

    servo, *others = case.scene.servos
    assert servo.limit is not None
    for limit in (1e9, 1.05 * servo.limit):
        servos = (msgspec.structs.replace(servo, limit=limit), *others)
        other = msgspec.structs.replace(case.scene, servos=servos)
        wrong = Record(other, record.batch, record.trajectory)
        assert not energy_balance.finding(wrong).passed.any()


def test_the_step_in_which_a_servo_lets_go_is_not_smooth() -> None:
    (case,) = (case for case in SERVO_CASES if case.name == "servo that lets go")
    record = _record(case.scene)

    assert np.flatnonzero(~record.steady[0]).tolist() == [23]  # 277/600 s are 23.1 frames


def test_a_slider_does_not_turn_however_fast_it_is() -> None:
    servo = Servo("rail", (300.0,), stiffness=1.0, limit=100.0)
    rail = Joint("rail", "slider", "world", "cart", NONE, (1.0, 0.0, 0.0), start=0.0, rate=200.0)
    cart = even("cart", 1.0, 0.1)
    scene = Scene("fast", (cart,), 400.0, gravity=NONE, joints=(rail,), servos=(servo,))
    record = _record(scene)
    off = 300.0 - record.trajectory.position[:, :, 0, 0]
    saturated = np.sign(off) * (np.abs(off) > 100.0)

    assert (record.steady == (saturated[:, 1:] == saturated[:, :-1])).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_hinge_that_starts_at_pi_stays_at_its_target_and_within_its_limits(seed: int) -> None:
    tree = random_tree(np.random.default_rng(seed), ["ball", "hinge"])
    law = {"start": np.pi, "stiffness": 5.0, "rest": np.pi, "limits": (0.0, np.pi)}
    joints = tuple(
        msgspec.structs.replace(joint, **law) if joint.kind == "hinge" else joint
        for joint in tree.joints
    )
    hinge = next(joint.name for joint in joints if joint.kind == "hinge")
    servo = Servo(hinge, position=(np.pi,), stiffness=30.0)
    still = {"gravity": (0.0, 0.0, 0.0), "clock": Clock(0.02, 10)}
    for changes in ({"joints": joints}, {"joints": joints, "servos": (servo,)}):
        scene = msgspec.structs.replace(tree, **still, **changes)
        motion = _record(scene).trajectory
        assert motion.failures == (None,)
        np.testing.assert_allclose(motion.position[0, -1], motion.position[0, 0], atol=1e-12)


def test_a_limit_that_is_never_reached_changes_nothing() -> None:
    (case,) = (case for case in SERVO_CASES if case.name == "servo that lets go")
    motions = []
    for limit in (None, 1e6):
        servos = (msgspec.structs.replace(case.scene.servos[0], limit=limit),)
        motions.append(_record(msgspec.structs.replace(case.scene, servos=servos)).trajectory)

    np.testing.assert_array_equal(motions[0].position, motions[1].position)


def test_a_stiff_servo_with_a_limit_is_solved_to_the_same() -> None:
    """A damper of 50 N·m·s/rad on 0.05 kg·m² decays 20 times a frame, once the limit lets it."""
    pin = Joint("pin", "hinge", "world", "rod", NONE, (0.0, 1.0, 0.0), rate=2.0)
    servo = Servo("pin", velocity=(1.0,), damping=50.0, limit=3.0)
    scene = Scene("stiff", (even("rod", 1.0, 0.05),), 1.0, joints=(pin,), servos=(servo,))
    record = _record(scene)
    rate = record.trajectory.angular_velocity[0, :, 0, 1]

    assert record.trajectory.failures == (None,)
    # It brakes by 60 rad/s² to within 3/50 rad/s, and then decays to the target.
    late = np.maximum(record.trajectory.time - 0.94 / 60.0, 0.0)
    braking = 2.0 - 60.0 * record.trajectory.time
    expected = np.where(late > 0.0, 1.0 + 0.06 * np.exp(-1000.0 * late), braking)
    np.testing.assert_allclose(rate, expected, atol=1e-7)


def test_stops_dry_friction_and_a_limited_servo_go_together() -> None:
    """A servo pushes a cart as hard as it can, against friction, into its stop."""
    rail = Joint(
        "rail", "slider", "world", "cart", NONE, (1.0, 0.0, 0.0),
        rate=0.0, friction=1.0, limits=(-1.0, 0.25),
    )  # fmt: skip
    servo = Servo("rail", (5.0,), stiffness=10.0, limit=3.0)
    scene = Scene("pushed", (even("cart", 2.0, 0.1),), 1.0, joints=(rail,), servos=(servo,))
    motion = solve(scene, draw_batch(scene, [0]), cache=False)

    x = np.minimum(0.5 * (3.0 - 1.0) / 2.0 * motion.time**2, 0.25)
    np.testing.assert_allclose(motion.position[0, :, 0, 0], x, atol=1e-10)
    assert motion.velocity[0, -1, 0, 0] == 0.0


def test_energy_of_a_limited_servo_is_not_stored() -> None:
    (case,) = (case for case in SERVO_CASES if case.name == "servo that lets go")
    assert not energy_of(_record(case.scene)).potential.any()


def test_a_limited_servo_on_a_joint_that_closes_a_loop_is_refused() -> None:
    pins = tuple(
        Joint(name, "hinge", "world", "rod", NONE, (0.0, 1.0, 0.0)) for name in ("one", "other")
    )
    servos = tuple(Servo(pin.name, damping=1.0, limit=2.0) for pin in pins)
    scene = Scene("twice", (even("rod", 1.0, 0.1),), 1.0, joints=pins, servos=servos)

    with pytest.raises(SceneError, match="got a servo with a limit on a joint that closes a loop"):
        Mechanism.of(scene)
