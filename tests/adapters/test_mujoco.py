"""MuJoCo's peculiarities: native models, closed loops, failures, and exact answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.scene.joint_space import to_bodies
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    DistanceLink,
    Inertia,
    Joint,
    Particle,
    Scene,
    SpringDamper,
    Torque,
)
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Profile, Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene, write_model
from mbds_xsim.testing.case import NONE, case_of, even
from tests.adapters.exact import worst_gap
from tests.random_scenes import Kind, random_links, random_tree

mujoco: Any = pytest.importorskip("mujoco")

Vector = tuple[float, float, float]
ENGINE = load_adapter("mujoco")
CLOCK = Clock(frame=0.02, steps=30)


def rollout(
    scene: Scene, batch: Batch, substeps: int, method: str = "RK4", **options: float | str
) -> Trajectory:
    settings = Settings(method, scene.clock.frame / substeps, options)
    with ENGINE.open(scene, settings) as run:
        return run.rollout(batch)


def position_errors(scene: Scene, substeps: tuple[int, ...], method: str = "RK4") -> list[float]:
    batch = draw_batch(scene, [0])
    exact = reference.solve(scene, batch, cache=False).position
    return [
        float(np.abs(rollout(scene, batch, count, method).position - exact).max())
        for count in substeps
    ]


def bar(name: str, start: Vector, end: Vector) -> Body:
    x, y, z = (0.5 * (a + b) for a, b in zip(start, end, strict=True))
    inertia = Inertia(1.0, (0.08, 0.09, 0.05), (0.0, 0.01, 0.0), com=(x, y, z))
    return Body(name, inertia=inertia)


def four_bar(torques: tuple[Torque, ...] = ()) -> Scene:
    """Close a planar loop by its fourth hinge, off the singular configuration."""
    a, b, c, d = (0.0, 0.0, 0.0), (0.0, 0.0, 0.6), (1.2, 0.0, 1.0), (1.0, 0.0, 0.0)
    y = (0.0, 1.0, 0.0)
    return Scene(
        name="four-bar",
        bodies=(bar("crank", a, b), bar("coupler", b, c), bar("rocker", c, d)),
        joints=(
            Joint("A", "hinge", "world", "crank", a, y, rate=2.0),
            Joint("B", "hinge", "crank", "coupler", b, y),
            Joint("C", "hinge", "coupler", "rocker", c, y),
            Joint("D", "hinge", "rocker", "world", d, y),
        ),
        torques=torques,
        length=1.0,
        clock=CLOCK,
    )


def linked(length: float | None = None) -> Scene:
    """Hang two bodies without joints by distance links."""
    return Scene(
        name="linked",
        bodies=(
            Body("upper", inertia=Inertia(1.0, (0.01, 0.01, 0.01), com=(0.5, 0.0, 0.0))),
            Body("lower", inertia=Inertia(0.5, (0.01, 0.02, 0.015), com=(1.0, 0.2, 0.1))),
        ),
        distance_links=(
            DistanceLink("first", ("world", "upper"), ((0, 0, 0), (0.5, 0, 0)), length),
            DistanceLink("second", ("upper", "lower"), ((0.5, 0, 0), (0.9, 0.2, 0.2))),
        ),
        length=1.0,
        clock=CLOCK,
    )


@pytest.mark.parametrize("seed", range(6))
def test_random_trees_move_as_the_reference_does(seed: int) -> None:
    """Trees have offset body frames, full inertias, joints either way, forces and torques."""
    rng = np.random.default_rng(seed)
    kinds: tuple[Kind, ...] = ("free", "hinge", "ball", "slider", "fixed", "hinge", "ball")
    scene = changed(random_tree(rng, kinds), Clock(frame=0.02, steps=5))
    mechanism = Mechanism.of(scene)
    start = to_bodies(mechanism, random_links(rng, mechanism, (1,)))
    batch = Batch(
        index=np.zeros(1, dtype=np.int64),
        position=start.position,
        orientation=mechanism.body_orientation(start.native),
        velocity=start.velocity,
        angular_velocity=start.angular_velocity,
        force=rng.standard_normal((1, 5, len(kinds), 3)),
        torque=rng.standard_normal((1, 5, len(mechanism.hinges))),
    )
    settings = Settings("RK4", 0.001)
    with ENGINE.open(scene, settings) as run:
        motion = run.rollout(batch)
        native = run.readback(batch)

    assert readback.compare(mechanism, batch, settings, native) == []
    exact = reference.solve(scene, batch, cache=False)
    np.testing.assert_allclose(motion.position, exact.position, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion.velocity, exact.velocity, rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion.angular_velocity, exact.angular_velocity, rtol=0, atol=1e-7)
    assert worst_gap(scene, motion) < 1e-13


def test_springs_and_dampers_converge_in_fourth_order() -> None:
    scene = Scene(
        name="sprung",
        bodies=(bar("arm", (0, 0, 0), (0.6, 0, 0)), bar("hand", (0.6, 0, 0), (1.0, 0.3, 0))),
        joints=(
            Joint("shoulder", "ball", "world", "arm", (0, 0, 0)),
            Joint("elbow", "ball", "arm", "hand", (0.6, 0, 0)),
        ),
        springs=(
            SpringDamper("a", ("hand", "world"), ((1, 0.3, 0), (1, 0.3, 2)), 40.0, 0.5, 1.2),
            SpringDamper("b", ("arm", "hand"), ((0.2, 0, 0.1), (1, 0.3, 0.1)), 30.0),
        ),
        length=1.0,
        clock=CLOCK,
    )
    errors = position_errors(scene, (2, 4, 8))
    assert np.log2(errors[0] / errors[2]) / 2 == pytest.approx(4.0, abs=0.2)
    assert errors[2] < 1e-7


@pytest.mark.parametrize(("profile", "speed"), [("matched", 7.36e-8), ("native", 5.2e-3)])
def test_a_joint_that_friction_holds_creeps(profile: Profile, speed: float) -> None:
    rail = (0.75**0.5, 0.0, -0.5)
    case = case_of(
        "held block",
        "",
        [even("block", 1.0, 0.1)],
        lambda time: np.zeros((len(time), 1, 3)),
        Joint("rail", "slider", "world", "block", NONE, rail, friction=8.0),
    )
    with ENGINE.open(case.scene, ENGINE.settings(case.scene, profile)) as run:
        motion = run.rollout(draw_batch(case.scene, [0]))

    assert np.linalg.norm(motion.velocity[0, -1]) == pytest.approx(speed, rel=0.02)
    exact = reference.solve(case.scene, draw_batch(case.scene, [0]), cache=False)
    assert np.abs(exact.position).max() == 0.0


def test_a_loop_hinge_tells_its_axis() -> None:
    scene = four_bar()
    batch = draw_batch(scene, [0])
    settings = ENGINE.settings(scene, "matched")
    with ENGINE.open(scene, settings) as run:
        native = run.readback(batch)
        assert run.size.constraints == 6
    assert native.joint_axis is not None
    np.testing.assert_allclose(native.joint_axis, [[0.0, 1.0, 0.0]] * 4, atol=1e-12)
    assert readback.compare(Mechanism.of(scene), batch, settings, native) == []


@pytest.mark.parametrize("length", [None, 0.7])
def test_distance_links_converge_in_second_order(length: float | None) -> None:
    errors = position_errors(linked(length), (8, 16, 32))
    assert np.log2(errors[0] / errors[2]) / 2 == pytest.approx(2.0, abs=0.2)
    assert errors[2] < 1e-3


def test_a_loop_of_fixed_joints_needs_no_constraint() -> None:
    names = ("x", "y", "z")
    scene = Scene(
        name="welded",
        bodies=tuple(bar(name, (0, 0, 0), (0.3 * k, 0.1, 1)) for k, name in enumerate(names)),
        joints=(
            Joint("pivot", "ball", "world", "x", (0, 0, 0)),
            *(Joint(f"w{k}", "fixed", names[k], names[k - 1], (0, 0, 1)) for k in range(3)),
        ),
        length=1.0,
        clock=CLOCK,
    )
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        assert (run.size.coordinates, run.size.constraints) == (3, 0)
    assert position_errors(scene, (8,))[0] < 1e-8


def test_implicitfast_is_euler_where_nothing_damps() -> None:
    pendulum = load_scene("5pendulum")
    batch = draw_batch(pendulum, [1]).truncated(10)
    both = [rollout(pendulum, batch, 10, method) for method in ("Euler", "implicitfast")]
    assert np.array_equal(both[0].position, both[1].position)


def test_native_profile_is_what_the_engine_does_by_itself() -> None:
    scene = load_scene("2ladder")
    settings = ENGINE.settings(scene, "native")
    assert settings.method == "Euler"
    assert settings.step == pytest.approx(0.002)
    with ENGINE.open(scene, settings) as run:
        text = run.native(draw_batch(scene, [0]))
    assert "solref" not in text
    assert "solimp" not in text


def test_matched_steps_follow_the_fastest_spring() -> None:
    def hung(stiffness: float) -> Scene:
        ends = ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
        return Scene(
            "hung",
            (Body("ball", particles=(Particle((0.0, 0.0, -1.0)),)),),
            length=1.0,
            springs=(SpringDamper("s", ("world", "ball"), ends, stiffness),),
        )

    steps = [ENGINE.settings(hung(stiffness), "matched").step for stiffness in (0.0, 1e4, 1e6)]
    assert steps[0] == pytest.approx(0.005)
    assert steps[1] == pytest.approx(0.02 / 16)
    assert steps[2] == pytest.approx(0.02 / 136)


def test_the_native_text_alone_gives_the_same_motion() -> None:
    """The text holds every digit of the model and of the start."""
    scene = load_scene("2ladder")
    batch = draw_batch(changed(scene, scene.clock, sampling=()), [0], noise=False)
    batch = batch.truncated(5)
    with ENGINE.open(scene, Settings("RK4", 0.005)) as run:
        ours = run.rollout(batch)
        text = run.native(batch)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_step(model, data, 20)
    mujoco.mj_forward(model, data)
    theirs = [data.body(body.name).xipos for body in scene.bodies]
    np.testing.assert_allclose(ours.position[0, -1], theirs, rtol=0, atol=1e-13)


def test_a_blow_up_ends_its_trajectory_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By itself, MuJoCo would reset the state to the reference pose, print, and write a file."""
    monkeypatch.chdir(tmp_path)
    scene = load_scene("2ladder")
    batch = draw_batch(scene, [0, 1])
    batch.force[0, 3:] = 1e12
    before = mujoco.get_mju_user_warning()
    motion = rollout(scene, batch.truncated(10), 2)
    failure = motion.failures[0]
    assert failure is not None
    assert 4 <= failure.frame <= 10
    assert "\n" not in failure.reason
    assert np.isnan(motion.position[0, failure.frame :]).all()
    assert np.isfinite(motion.position[0, : failure.frame]).all()
    assert motion.failures[1] is None
    alone = rollout(scene, batch.truncated(10)[[1]], 2)
    assert np.array_equal(motion.position[1], alone.position[0])
    assert list(tmp_path.iterdir()) == []
    assert mujoco.get_mju_user_warning() is before


def test_loops_tighter_than_euler_holds_are_a_failure_with_the_engine_s_reason() -> None:
    scene = four_bar()
    motion = rollout(scene, draw_batch(scene, [0]), 2, "Euler", loop_time_constant=1.0)
    failure = motion.failures[0]
    assert failure is not None
    assert "QACC" in failure.reason


def test_solvers_agree_on_a_redundant_loop() -> None:
    scene = four_bar()
    batch = draw_batch(scene, [0])
    newton, dual, gradient = (
        rollout(scene, batch, 8, solver=name).position for name in ("Newton", "PGS", "CG")
    )
    np.testing.assert_allclose(dual, newton, rtol=0, atol=1e-5)
    np.testing.assert_allclose(gradient, newton, rtol=0, atol=1e-5)


def test_wrong_options_are_refused() -> None:
    scene = load_scene("ballscroll")
    for name, value in (
        ("solver", "Jacobi"),
        ("solver", "PGS"),
        ("loop_time_constant", -1.0),
        ("link_time_constant", float("inf")),
        ("contact_substeps", -1),
        ("contact_substeps", 2.5),
        ("impact_steps", 2),
    ):
        with pytest.raises(InputError, match=name.split("_")[0]):
            ENGINE.open(scene, Settings("RK4", 0.01, {name: value}))


def test_a_slider_loop_is_refused_with_the_reason() -> None:
    rails = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0))
    scene = Scene(
        name="rails",
        bodies=(bar("x", (0, 0, 0), (1, 0, 0)), bar("y", (0, 0, 0), (0, 0, 1))),
        joints=(
            Joint("a", "slider", "world", "x", (0, 0, 0), rails[0]),
            Joint("b", "slider", "x", "y", (0, 0, 0), rails[1]),
            Joint("c", "slider", "world", "y", (0, 0, 0), rails[2]),
        ),
        length=1.0,
    )
    with pytest.raises(Unsupported, match="sliding direction"):
        ENGINE.open(scene, ENGINE.settings(scene, "matched"))


@pytest.mark.parametrize(
    ("name", "step", "options"),
    [("6pendulum", 0.005, {}), ("3ladder", 0.01, {"solver": "PGS"})],
)
def test_budgets_are_met_at_the_step_that_the_documents_name(
    name: str, step: float, options: dict[str, str]
) -> None:
    """One second of a low and a medium trajectory meets the budgets, with noise and inputs."""
    scene = load_scene(name)
    batch = draw_batch(scene, [0, 1]).truncated(50)
    exact = reference.solve(scene, batch, cache=False)
    with ENGINE.open(scene, Settings("RK4", step, options)) as run:
        motion = run.rollout(batch)
    mechanism = Mechanism.of(scene)

    def particles(trajectory: Trajectory) -> Array:
        return mechanism.particle_positions(trajectory.position, trajectory.orientation)

    off = particles(motion) - particles(exact)
    error = np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=-1))
    assert error.max() < 0.1 * scene.budget.error_1s * scene.length
    assert worst_gap(scene, motion) < 0.1 * scene.budget.gap


def changed(scene: Scene, clock: Clock, **fields: Any) -> Scene:
    return msgspec.structs.replace(scene, clock=clock, **fields)


@pytest.mark.parametrize(
    ("moments", "products"),
    [
        ((5.912131057923787, 3.235213578491161, 5.018128761055044),
         (0.7440626156639037, 1.5100583687462041, -0.33238221357657016)),
        ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)),
    ],
)  # fmt: skip
def test_flat_bodies_turned_in_their_frames_run(moments: Vector, products: Vector) -> None:
    """A + B = C of such a body holds only up to rounding, which the compiler does not allow for."""
    plate = Body("plate", inertia=Inertia(1.0, moments, products))
    hinge = Joint("pivot", "hinge", "world", "plate", (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), start=0.5)
    scene = Scene("plate", (plate,), length=1.0, joints=(hinge,), clock=CLOCK)

    (error,) = position_errors(scene, (10,))
    assert error < 1e-9
    stated = " ".join(map(repr, (*moments, *products)))
    text = write_model(scene, "mjcf").text
    assert (f'fullinertia="{stated}"' in text) == (not any(products))
