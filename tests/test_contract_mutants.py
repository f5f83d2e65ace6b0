"""Wrong adapters that the contract suite must not pass: a sound one with one defect each."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.claims import RTOL, Feature, Option
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.testing import CASES, AdapterContract, Case
from tests.faults.native import no_reaction
from tests.faults.planting import Change, Faulty

_SUITE = AdapterContract()
_POSITIONS = _SUITE.test_every_method_converges_to_the_answer_in_its_order
_VELOCITIES = _SUITE.test_velocities_are_those_of_the_motion


def _mutant(engine: str, **defect: Any) -> Adapter:
    return Faulty(load_adapter(engine), Change(**defect))


def _case(name: str) -> Case:
    (case,) = (case for case in CASES if case.name == name)
    return case


def _reversed_forces(batch: Batch) -> Batch:
    return dataclasses.replace(batch, force=batch.force[:, :, ::-1])


def _idle_motors(batch: Batch) -> Batch:
    return dataclasses.replace(batch, torque=np.zeros_like(batch.torque))


def _open_loops(scene: Scene) -> Scene:
    loops = {joint.name for joint in Mechanism.of(scene).loops}
    joints = tuple(joint for joint in scene.joints if joint.name not in loops)
    return msgspec.structs.replace(scene, joints=joints, distance_links=())


def _stale_chart(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    """Leave angular velocities in a body's own axes once it has turned far from its start."""
    back = rotation.conjugate(motion.orientation)
    turned = rotation.multiply(back[:, :1], motion.orientation)
    far = np.linalg.norm(rotation.to_vector(turned), axis=-1, keepdims=True) > 2.0
    assert far.any()
    local = rotation.rotate(back, motion.angular_velocity)
    return dataclasses.replace(
        motion, angular_velocity=np.where(far, local, motion.angular_velocity)
    )


@pytest.mark.parametrize(
    ("name", "defect", "test", "case"),
    [
        ("mujoco", {"inputs": _reversed_forces}, _POSITIONS, "pushed"),
        ("mujoco", {"inputs": _reversed_forces}, _POSITIONS, "chain of balls"),
        ("mujoco", {"inputs": _idle_motors}, _POSITIONS, "Hooke's joint"),
        ("mujoco", {"inputs": _idle_motors}, _POSITIONS, "welded"),
        ("mujoco", {"motion": _stale_chart}, _VELOCITIES, "chain of balls"),
        ("pybullet", {"model": _open_loops}, _POSITIONS, "ball loop"),
        ("exudyn", {"model": _open_loops}, _POSITIONS, "wedge"),
        ("mujoco", {"model": _open_loops}, _POSITIONS, "linked"),
    ],
)
def test_a_wrong_adapter_fails(
    name: str, defect: dict[str, Any], test: Callable[[Adapter, Case], None], case: str
) -> None:
    test(load_adapter(name), _case(case))
    with pytest.raises(AssertionError, match=case):
        test(_mutant(name, **defect), _case(case))


def _each(motion: Trajectory, change: Callable[[str, Array], Array]) -> Trajectory:
    arrays: dict[str, Any] = {key: change(key, getattr(motion, key)) for key in STATES}
    return dataclasses.replace(motion, **arrays)


def _short_numbers(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    return _each(motion, lambda _, values: values.astype(np.float32))


def _lost_rates(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    motion.angular_velocity[:, 20:] = np.nan
    return motion


def _milliseconds(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    return dataclasses.replace(motion, time=1000.0 * motion.time)


def _used_up(batch: Batch) -> Batch:
    given = dataclasses.replace(batch, force=batch.force.copy())
    batch.force[:] = 0.0
    return given


@pytest.mark.parametrize(
    ("defect", "told"),
    [
        ({"motion": _short_numbers}, "gave position as float32"),
        ({"motion": _lost_rates}, "RK4 on pushed: NaN or infinity, without a Failure"),
        ({"motion": _milliseconds}, "gave frame 1 the time 20 s, not 0.02 s"),
        ({"inputs": _used_up}, "RK4 on pushed: rollout changes force of the batch it is given"),
        ({"inputs": _reversed_forces}, "which shorter steps hardly reduce"),
    ],
)
def test_what_an_adapter_does_wrong_is_named(defect: dict[str, Any], told: str) -> None:
    mutant = _mutant("mujoco", **defect)
    mutant.methods = {"RK4": mutant.methods["RK4"]}  # type: ignore[misc]
    with pytest.raises((AssertionError, ValueError), match=told):
        _POSITIONS(mutant, _case("pushed"))


def _first_alone(batch: Batch) -> Batch:
    return batch[[0] * len(batch)]


def _whole_clock(batch: Batch) -> Batch:
    rest = ((0, 0), (0, 50 - batch.steps), (0, 0))
    force, torque = np.pad(batch.force, (*rest, (0, 0))), np.pad(batch.torque, rest)
    return dataclasses.replace(batch, force=force, torque=torque)


_HELD: dict[tuple[str, tuple[int, ...]], Array] = {}


def _held(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    """Return the same arrays every time."""

    def held(key: str, values: Array) -> Array:
        array = _HELD.setdefault((key, values.shape), np.empty_like(values))
        array[:] = values
        return array

    return _each(motion, held)


@pytest.mark.parametrize(
    ("defect", "test", "told"),
    [
        (
            {"inputs": _first_alone},
            _SUITE.test_trajectories_of_a_batch_do_not_touch_each_other,
            "trajectory 1, beside the other",
        ),
        (
            {"motion": _held},
            _SUITE.test_trajectories_of_a_batch_do_not_touch_each_other,
            "a result is overwritten later",
        ),
        ({"inputs": _whole_clock}, _SUITE.test_a_shorter_batch_ends_earlier, r"\(1, 51, 1, 3\)"),
    ],
)
def test_batches_of_which_an_adapter_takes_another_part_fail(
    defect: dict[str, Any], test: Callable[[Adapter], None], told: str
) -> None:
    test(load_adapter("mujoco"))
    with pytest.raises(AssertionError, match=told):
        test(_mutant("mujoco", **defect))


def test_a_trajectory_that_is_lost_among_others_on_the_ground_fails() -> None:
    def lost(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
        motion.position[1, 20:] = np.nan
        return motion

    with pytest.raises(AssertionError, match=r"RK4 on .*: NaN or infinity, without a Failure"):
        _SUITE.test_on_the_ground_bodies_follow_the_answer(
            _mutant("mujoco", motion=lost), "slide to roll"
        )


def test_an_order_that_is_not_reached_fails() -> None:
    mutant = _mutant("mujoco")
    mutant.methods = {"RK4": dataclasses.replace(mutant.methods["RK4"], order=5)}  # type: ignore[misc]

    with pytest.raises(AssertionError, match="RK4 is of lower order than declared"):
        _SUITE.test_declared_orders_are_not_beaten_everywhere(mutant)


def test_an_order_that_a_tolerance_hides_is_not_judged() -> None:
    """Errors that level off, as with loops closed to a tolerance, show no order."""

    def shifted(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
        motion.position[:, 1:] += 2e-10
        return motion

    mutant = _mutant("mujoco", motion=shifted)
    mutant.methods = {"RK4": mutant.methods["RK4"]}  # type: ignore[misc]
    _SUITE.test_declared_orders_are_not_beaten_everywhere(mutant)


def test_a_hinge_torque_without_its_reaction_fails(engine: str) -> None:
    with no_reaction(engine), pytest.raises(AssertionError, match="flywheel"):
        _POSITIONS(load_adapter(engine), _case("flywheel"))


def test_a_velocity_lag_that_is_not_declared_fails() -> None:
    mutant = _mutant("mujoco")
    mutant.methods = {  # type: ignore[misc]
        name: dataclasses.replace(method, velocity_lag=0.0)
        for name, method in mutant.methods.items()
    }

    with pytest.raises(AssertionError, match=r"Euler on rod: velocity lag: .* kinematics: "):
        _VELOCITIES(mutant, _case("rod"))


_dart_closure = importlib.import_module("mbds_xsim_adapters.dart.script")._closure


def _ball_closure(mechanism: Mechanism, joint: PlacedJoint) -> Iterator[str]:
    calls: Iterator[str] = _dart_closure(mechanism, dataclasses.replace(joint, kind="ball"))
    return calls


@pytest.mark.parametrize(
    ("name", "mutation"),
    [
        ("mujoco", mock.patch.dict("mbds_xsim_adapters.mujoco.model.CLOSING_POINTS", hinge=(0.0,))),
        (
            "dart",
            mock.patch("mbds_xsim_adapters.dart.script._closure", _ball_closure),
        ),
    ],
)
def test_a_hinge_loop_made_as_a_ball_fails_in_space_alone(name: str, mutation: Any) -> None:
    with mutation:
        _POSITIONS(load_adapter(name), _case("parallelogram"))
        with pytest.raises(AssertionError, match="Hooke"):
            _POSITIONS(load_adapter(name), _case("Hooke's joint"))


def test_an_engine_without_ball_joints_passes() -> None:
    """Features that an engine does not claim are refused, and the suite asks no more of it."""
    mutant = _mutant("mujoco")
    reason = "its joints turn about one axis"
    balls = dict.fromkeys((Feature.BALL, Feature.LOOP_BALL), reason)
    mutant.limits = {**mutant.limits, **balls}  # type: ignore[misc]

    for test in (
        _SUITE.test_declared_orders_are_not_beaten_everywhere,
        _SUITE.test_frame_zero_is_the_start,
        _SUITE.test_same_batch_same_bits,
        _SUITE.test_two_open_runs_do_not_touch_each_other,
        _SUITE.test_what_cannot_be_done_is_refused_with_the_reason,
        _SUITE.test_wrong_settings_are_refused_in_one_line,
    ):
        test(mutant)
    with pytest.raises(Unsupported, match=reason):
        mutant.open(_case("rod").scene, Settings("RK4", 0.02))


def test_an_adaptive_method_that_does_not_heed_its_tolerance_fails() -> None:
    deaf = _mutant("mujoco")
    deaf.methods = {"RK4": dataclasses.replace(deaf.methods["RK4"], adaptive=True)}  # type: ignore[misc]
    deaf.options = {**deaf.options, RTOL: Option(1e-6, "of nothing")}  # type: ignore[misc]

    with pytest.raises(AssertionError, match=r"RK4 on rod: declared order 0\.8, measured -?0\.00"):
        _POSITIONS(deaf, _case("rod"))


def test_an_engine_says_where_loops_are_cut() -> None:
    case = _case("parallelogram")
    *others, last = case.scene.joints
    ball = msgspec.structs.replace(last, kind="ball", axis=None)
    scene = msgspec.structs.replace(case.scene, joints=(*others, ball))
    mutant = _mutant("mujoco")
    balls = dict.fromkeys((Feature.BALL, Feature.LOOP_BALL), "its joints turn about one axis")
    mutant.limits = balls  # type: ignore[misc]

    assert set(mutant.refusals(scene, "RK4")) == {Feature.LOOP_BALL}
    mutant.cut = ("hinge", "ball", "slider", "fixed")  # type: ignore[misc]
    assert set(mutant.refusals(scene, "RK4")) == {Feature.BALL}
    assert [joint.kind for joint in Mechanism.of(scene, mutant.cut).loops] == ["hinge"]
    assert [joint.kind for joint in Mechanism.of(scene).loops] == ["ball"]
