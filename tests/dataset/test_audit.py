"""`mbds-xsim audit`: trajectories from elsewhere, right ones and planted wrong ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.dataset.points import recover
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import STATES
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.joint_cases import JOINT_CASES

from .foreign_files import INDEX, Arrays, Audit, checks_of, failed_in, only, simulated


def test_all_checks_run_on_states_of_bodies(rod: Scene, swing: Arrays, audited: Audit) -> None:
    result = audited(rod, swing)
    assert result.reasons == ()
    assert {"finite", "start", "gap", "kinematics", "energy", "force", "particles"} <= checks_of(
        result
    )
    assert {"error growth-weighted", "error of turns"} <= checks_of(result)
    assert set(result.not_checked) == {"error at 1 s"}  # it lasts a fifth of a second


def test_velocities_of_particles_without_those_of_bodies_are_not_checked(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    part = only(swing, "body/position", "body/orientation", "velocity")
    result = audited(rod, part)
    assert result.not_checked["particle velocities"] == "no velocities of bodies"
    assert "particle velocities" in checks_of(audited(rod, swing))


def test_float32_is_no_fault(rod: Scene, swing: Arrays, audited: Audit) -> None:
    coarse = {name: values.astype(np.float32) for name, values in swing.items()}
    result = audited(rod, coarse)
    assert result.verdict == "pass"
    assert any(line.startswith("rounding") for line in result.taken)


def test_a_start_rounded_beyond_its_budget_is_told(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    """A figure far above its budget may pass only with a word about why."""
    points = only(swing, "position")
    coarse = audited(rod, points | {"position": points["position"].astype(np.float32)})
    (start,) = (finding for finding in coarse.findings if finding.check == "start")

    assert start.passed
    assert start.budget is not None
    assert start.figure > 1e3 * start.budget
    assert "rounding: start may be off by up to 3e-08" in coarse.taken
    assert not any(line.startswith("rounding") for line in audited(rod, points).taken)


@pytest.mark.parametrize(
    ("name", "fault", "sees"),
    [
        ("body/position", lambda x: x + 0.001, {"start", "gap"}),
        ("body/velocity", lambda x: 1.02 * x, {"start", "energy", "momentum"}),
        ("body/velocity", lambda x: x[:, [0, *range(10)]], {"velocity lag", "energy"}),
        ("body/orientation", lambda x: 1.001 * x, {"finite"}),
        ("body/orientation", lambda x: x[..., [1, 2, 3, 0]], {"start", "gap"}),
        ("input/force", lambda x: 0.5 * x, {"force"}),
        ("position", lambda x: x[:, ::-1], {"particles"}),
        ("velocity", lambda x: -x, {"particle velocities"}),
    ],
)
def test_planted_faults_are_found(
    name: str,
    fault: Callable[[Any], Any],
    sees: set[str],
    rod: Scene,
    swing: Arrays,
    audited: Audit,
) -> None:
    result = audited(rod, swing | {name: fault(swing[name])})
    assert sees <= failed_in(result)


def test_wrong_inputs_are_found_however_small_they_are(rod: Scene, audited: Audit) -> None:
    gentle = msgspec.structs.replace(rod, noise=1e-10)
    arrays = simulated(gentle)
    assert audited(gentle, arrays).reasons == ()
    wrong = arrays | {"input/force": 2.0 * arrays["input/force"]}
    assert failed_in(audited(gentle, wrong)) == {"force"}


def test_an_unnamed_start_is_the_files_own(rod: Scene, swing: Arrays, audited: Audit) -> None:
    result = audited(rod, swing, Provenance())
    assert result.verdict == "pass"
    errors = {"error at 1 s", "error growth-weighted", "error of turns"}
    assert {"start", *errors} == set(result.not_checked)
    assert "forces: those of the file" in result.taken


def test_an_order_that_friction_in_joints_lowers_is_told(audited: Audit) -> None:
    (brake,) = (case.scene for case in JOINT_CASES if case.name == "brake")
    scene = msgspec.structs.replace(brake, clock=Clock(steps=5))
    arrays = only(simulated(scene), *(f"body/{key}" for key in STATES))
    result = audited(scene, arrays, Provenance(method_order=4))
    assert (
        "method: of order 4, judged as of order 1 (forces have kinks), velocities at the frames"
        in result.taken
    )
    (energy,) = (one for one in result.findings if one.check == "energy")
    assert energy.budget == scene.budget.energy_first_order


def test_forces_that_are_not_told_are_missed(rod: Scene, swing: Arrays, audited: Audit) -> None:
    """Noise that acted but is not in the file must not pass as physics."""
    states = only(swing, *(f"body/{key}" for key in STATES))
    without = audited(rod, states, Provenance())
    assert "forces: none but what the scene lists" in without.taken
    energy = {finding.check: finding.figure for finding in without.findings}["energy"]
    complete = audited(rod, swing, Provenance())
    assert energy > 100 * {one.check: one.figure for one in complete.findings}["energy"]


def test_a_wrong_turn_is_seen_beside_the_reference(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    """A turn about the rod's own axis moves no particle."""
    q = swing["body/orientation"]
    about = rotation.from_vector(np.array([0.0, 0.0, 0.2]))
    turned = swing | {"body/orientation": rotation.multiply(q, np.broadcast_to(about, q.shape))}
    assert "error of turns" in failed_in(audited(rod, turned))
    assert "error growth-weighted" not in failed_in(audited(rod, turned))


def test_positions_alone_leave_velocities_unchecked(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    result = audited(rod, only(swing, "body/position", "body/orientation"))
    assert result.verdict == "pass"
    assert result.not_checked["energy"] == "no velocities"
    assert {"finite", "start", "gap"} <= checks_of(result)
    assert not {"energy", "kinematics", "momentum"} & checks_of(result)


@pytest.mark.parametrize(("limits", "verdict"), [((-4.0, 4.0), "pass"), ((-1e-3, 1e-3), "fail")])
def test_positions_alone_show_whether_joints_keep_their_limits(
    limits: tuple[float, float], verdict: str, audited: Audit
) -> None:
    (brake,) = (case.scene for case in JOINT_CASES if case.name == "brake")
    free = msgspec.structs.replace(brake, clock=Clock(steps=5))
    arrays = only(simulated(free), "body/position", "body/orientation")
    joints = tuple(
        msgspec.structs.replace(joint, limits=limits) if joint.kind == "hinge" else joint
        for joint in free.joints
    )
    result = audited(msgspec.structs.replace(free, joints=joints), arrays, Provenance())
    assert result.verdict == verdict
    assert failed_in(result) == ({"past limits"} if verdict == "fail" else set())
    assert result.not_checked["stop passivity"] == "no velocities"


def test_positions_alone_do_not_turn_hinges_at_the_rates_of_the_start(audited: Audit) -> None:
    """A brake stops a wheel within half a turn; at the rate of its start it would go on."""
    (brake,) = (case.scene for case in JOINT_CASES if case.name == "brake")
    brake = msgspec.structs.replace(brake, clock=Clock(steps=100))
    joints = tuple(
        msgspec.structs.replace(joint, limits=(-4.0, 4.0)) if joint.name == "axle" else joint
        for joint in brake.joints
    )
    arrays = only(simulated(brake), "body/position", "body/orientation")
    seldom = {name: values[:, ::100] for name, values in arrays.items() if name != "time"}
    scene = msgspec.structs.replace(brake, joints=joints)
    result = audited(scene, seldom | {"time": arrays["time"][::100]}, Provenance())
    assert "past limits" in checks_of(result)
    assert result.reasons == ()


@pytest.mark.parametrize("name", ["ballscroll", "balldrop"])
def test_checks_of_flights_are_told_wherever_a_motion_starts(name: str, audited: Audit) -> None:
    scene = msgspec.structs.replace(load_scene(name), clock=Clock(steps=2))
    result = audited(scene, only(simulated(scene), "body/position", "body/orientation"))
    flights = {"energy", "momentum", "kinematics", "velocity lag", "coefficients"}
    assert flights <= set(result.not_checked)


def test_checks_of_joints_are_told_where_friction_holds_them_at_the_start(audited: Audit) -> None:
    (dragged,) = (case.scene for case in JOINT_CASES if case.name == "dragged block")
    scene = msgspec.structs.replace(dragged, clock=Clock(frame=0.02, steps=5))
    result = audited(scene, only(simulated(scene), "body/position", "body/orientation"))
    assert {"kinematics", "velocity lag"} <= set(result.not_checked)


def test_single_precision_needs_no_order_beside_it(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    motion = {name: swing[name] for name in swing if name.startswith(("time", "body", "input"))}
    for key in STATES:
        motion[f"body/{key}"] = motion[f"body/{key}"].astype(np.float32).astype(np.float64)
    turns = motion["body/orientation"]
    motion["body/orientation"] = turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    assert {"precision", "start"} <= failed_in(audited(rod, motion))
    assert audited(rod, motion, Provenance(INDEX, seed=7, single_precision=True)).reasons == ()


def test_particles_of_a_rod_tell_its_length(rod: Scene, swing: Arrays, audited: Audit) -> None:
    result = audited(rod, only(swing, "position"))
    assert result.verdict == "pass"
    assert {"rigidity", "start", "error growth-weighted"} == checks_of(result)
    for left_out in ("energy", "error of turns"):
        assert "do not show how" in result.not_checked[left_out]
    longer = audited(rod, only(swing | {"position": 1.01 * swing["position"]}, "position"))
    assert {"rigidity", "start"} <= failed_in(longer)


def test_particles_of_a_disc_tell_all(drop: tuple[Scene, Arrays], audited: Audit) -> None:
    scene, arrays = drop
    result = audited(scene, only(arrays, "position", "velocity"))
    assert result.reasons == ()
    assert {"start", "energy", "friction", "restitution", "rigidity"} <= checks_of(result)
    assert {"error growth-weighted", "error of turns"} <= checks_of(result)
    assert any("fitted" in line for line in result.taken)
    fit = recover(scene, arrays["position"], arrays["velocity"])
    for key in STATES[:1] + STATES[2:]:
        np.testing.assert_allclose(getattr(fit, key), arrays[f"body/{key}"], atol=1e-9)
    facing = np.abs(np.sum(fit.orientation * arrays["body/orientation"], axis=-1))
    np.testing.assert_allclose(facing, 1.0, atol=1e-12)


def test_rounding_does_not_excuse_another_start(drop: tuple[Scene, Arrays], audited: Audit) -> None:
    """A float32 start that is moved by a tenth of a millimetre, or sheared as little, fails."""
    scene, arrays = drop
    points = arrays["position"].astype(np.float32)
    assert "start" not in failed_in(audited(scene, {"time": arrays["time"], "position": points}))
    turned = points + 1e-4 * (points[..., ::-1] - points.mean(axis=2, keepdims=True))
    for moved in (points + np.float32(1e-4), turned):
        assert "start" in failed_in(audited(scene, {"time": arrays["time"], "position": moved}))


def test_a_learned_models_wobble_is_seen(drop: tuple[Scene, Arrays], audited: Audit) -> None:
    scene, arrays = drop
    shake = np.random.default_rng(0).normal(scale=1e-3, size=arrays["position"].shape)
    result = audited(scene, only(arrays | {"position": arrays["position"] + shake}, "position"))
    assert "rigidity" in failed_in(result)
