"""DART's own ways, and exact answers on small scenes."""

import gc
import math
import weakref
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.scene.mechanism import JointKind, Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    DistanceLink,
    Inertia,
    Joint,
    Scene,
    SpringDamper,
    Torque,
)
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.readback import compare
from mbds_xsim.simulate.registry import load_adapter, load_scene

dartpy = pytest.importorskip("dartpy")

ENGINE = load_adapter("dart")
RK4, EULER = "forward-dynamics-RK4", "semi-implicit-euler"
SECOND = Clock(steps=50)
Y = (0.0, 1.0, 0.0)
OBLIQUE = (0.0, 2.0, 1.0)
BRICK = Inertia(2.0, (0.05, 0.08, 0.1), (0.01, -0.005, 0.02), com=(0.15, 0.02, 0.05))


def roll(scene: Scene, method: str, substeps: int, **options: float) -> Trajectory:
    with ENGINE.open(scene, Settings(method, scene.clock.frame / substeps, options)) as run:
        return run.rollout(draw_batch(scene, [0]))


def turned(motion: Trajectory, body: int, axis: tuple[float, float, float] = Y) -> Array:
    """Unwrapped angle of a body about an axis [rad], shape (frame,)."""
    return np.unwrap(rotation.angle_about(motion.orientation[0, :, body], np.array(axis)))


def held(kind: JointKind, axis: tuple[float, float, float] | None = None) -> Scene:
    """Hold one brick with one joint at the origin."""
    rate = None if axis is None else 1.0
    joint = Joint("joint", kind, "world", "brick", (0.0, 0.0, 0.0), axis=axis, rate=rate)
    return Scene("held", (Body("brick", inertia=BRICK),), 1.0, joints=(joint,), clock=SECOND)


def four_bar(top: JointKind, back: JointKind, torque: float = 0.0) -> Scene:
    """Make a parallelogram of two 0.5 m cranks and a 1 m coupler, swinging in x and z."""
    axis = {kind: Y if kind == "hinge" else None for kind in ("hinge", "ball")}
    return Scene(
        name="four-bar",
        bodies=(
            Body("left", inertia=Inertia(1.0, (0.02, 0.02, 0.01), com=(0.0, 0.0, -0.25))),
            Body("coupler", inertia=Inertia(1.5, (0.01, 0.03, 0.03), com=(0.5, 0.0, -0.5))),
            Body("right", inertia=Inertia(1.0, (0.02, 0.02, 0.01), com=(1.0, 0.0, -0.25))),
        ),
        joints=(
            Joint("front", "hinge", "world", "left", (0.0, 0.0, 0.0), axis=Y, start=1.0, rate=0.5),
            Joint("top", top, "left", "coupler", (0.0, 0.0, -0.5), axis=axis[top]),
            Joint("far", "hinge", "coupler", "right", (1.0, 0.0, -0.5), axis=Y),
            Joint("back", back, "world", "right", (1.0, 0.0, 0.0), axis=axis[back]),
        ),
        torques=(Torque("back", (torque,)),) if torque else (),
        length=1.0,
        clock=SECOND,
    )


def four_bar_angle(time: Array, torque: float = 0.0) -> Array:
    """Angle of the cranks [rad]: the coupler moves without turning, one equation is left."""
    inertia = 2 * (0.02 + 1.0 * 0.25**2) + 1.5 * 0.5**2
    pull = 9.81 * (2 * 1.0 * 0.25 + 1.5 * 0.5)
    return integrated(
        lambda _, y: np.array([y[1], (torque - pull * math.sin(y[0])) / inertia]), [1.0, 0.5], time
    )[0]


def integrated(rate: object, start: list[float], time: Array) -> Array:
    solution = solve_ivp(rate, (0, time[-1]), start, "DOP853", time, rtol=1e-12, atol=1e-12)
    return np.asarray(solution.y)


@pytest.mark.parametrize(("method", "substeps", "near"), [(RK4, 4, 1e-5), (EULER, 100, 2e-3)])
def test_hinge(method: str, substeps: int, near: float) -> None:
    scene = held("hinge", OBLIQUE)
    mechanism = Mechanism.of(scene)
    arm, axis = mechanism.com[0], mechanism.joints[0].axis
    inertia = axis @ mechanism.inertia[0] @ axis + 2.0 * np.sum(np.cross(axis, arm) ** 2)

    def rate(_: float, y: Array) -> Array:
        lever = rotation.rotate(rotation.from_vector(y[0] * axis), arm)
        return np.array([y[1], axis @ np.cross(lever, [0.0, 0.0, -2.0 * 9.81]) / inertia])

    motion = roll(scene, method, substeps)
    exact = integrated(rate, [0.0, 1.0], motion.time)[0]
    np.testing.assert_allclose(turned(motion, 0, tuple(axis)), exact, rtol=0, atol=near)


def test_slider_falls_along_its_axis() -> None:
    motion = roll(held("slider", OBLIQUE), RK4, 1)
    axis = np.array(OBLIQUE) / math.sqrt(5.0)
    along = motion.time - 0.5 * 9.81 * axis[2] * motion.time**2
    moved = motion.position[0, :, 0] - np.array(BRICK.com)
    np.testing.assert_allclose(moved, along[:, None] * axis, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion.orientation[0, :, 0, 0], 1.0, rtol=0, atol=1e-15)


def test_fixed_parts_move_as_one_body() -> None:
    parts = tuple(
        Body(name, inertia=Inertia(1.0, (0.02, 0.03, 0.01), com=com))
        for name, com in (("a", (0.1, 0.0, 0.0)), ("b", (0.3, 0.2, 0.0)))
    )
    hang = Joint("hang", "ball", "world", "a", (0.0, 0.0, 0.0))
    glue = Joint("glue", "fixed", "b", "a", (0.2, 0.1, 0.0))
    # Parallel axes, about the common centre of mass (0.2, 0.1, 0).
    whole = Inertia(2.0, (0.06, 0.08, 0.06), (-0.02, 0.0, 0.0), com=(0.2, 0.1, 0.0))
    one = Scene("one", (Body("a", inertia=whole),), 1.0, joints=(hang,), clock=SECOND)
    two = Scene("two", parts, 1.0, joints=(hang, glue), clock=SECOND)
    expected, got = (roll(scene, RK4, 4) for scene in (one, two))
    for body in (0, 1):
        np.testing.assert_allclose(
            got.orientation[0, :, body], expected.orientation[0, :, 0], rtol=0, atol=1e-10
        )
    np.testing.assert_allclose(
        got.position[0].mean(axis=1), expected.position[0, :, 0], rtol=0, atol=1e-10
    )


def test_semi_implicit_euler_falls_half_a_step_too_far() -> None:
    body = Body("brick", inertia=BRICK, velocity=(1.0, 0.0, 0.0))
    motion = roll(Scene("drop", (body,), length=1.0), EULER, 4)
    moved = motion.position[0, :, 0] - np.array(BRICK.com)
    drop = 0.5 * 9.81 * motion.time * (motion.time + 0.005)
    np.testing.assert_allclose(moved[:, 2], -drop, rtol=0, atol=1e-10)
    np.testing.assert_allclose(moved[:, 0], motion.time, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("method", "substeps", "near"), [(RK4, 10, 1e-6), (EULER, 200, 2e-2)])
def test_free_body_tumbles(method: str, substeps: int, near: float) -> None:
    spin = np.array([0.3, 4.0, 0.3])
    body = Body("brick", inertia=BRICK, angular_velocity=(0.3, 4.0, 0.3))
    motion = roll(Scene("tumble", (body,), length=1.0, clock=SECOND), method, substeps)
    tensor = Mechanism.of(Scene("tumble", (body,), length=1.0)).inertia[0]

    def rate(_: float, y: Array) -> Array:
        turn = rotation.matrix(y[:4] / np.linalg.norm(y[:4]))
        w = np.linalg.solve(turn @ tensor @ turn.T, tensor @ spin)
        return 0.5 * rotation.multiply(np.array([0.0, *w]), y[:4])

    exact = integrated(rate, [1.0, 0.0, 0.0, 0.0], motion.time).T
    np.testing.assert_allclose(motion.orientation[0, :, 0], exact, rtol=0, atol=near)
    turn = rotation.matrix(motion.orientation[0, :, 0])
    momentum = turn @ tensor @ turn.swapaxes(1, 2) @ motion.angular_velocity[0, :, 0, :, None]
    np.testing.assert_allclose(momentum[:, :, 0], np.tile(tensor @ spin, (51, 1)), atol=near)


@pytest.mark.parametrize(("method", "substeps", "near"), [(RK4, 10, 1e-6), (EULER, 400, 3e-3)])
def test_spring_and_damper_between_two_bodies(method: str, substeps: int, near: float) -> None:
    bodies = tuple(
        Body(name, inertia=Inertia(mass, (0.1, 0.2, 0.2)), position=(x, 0.0, 0.0))
        for name, mass, x in (("a", 1.0, 0.0), ("b", 3.0, 1.0))
    )
    ends = ((0.1, 0.0, 0.0), (0.8, 0.0, 0.0))
    spring = SpringDamper("s", ("a", "b"), ends, stiffness=30.0, damping=1.0, rest_length=0.5)
    still = (0.0, 0.0, 0.0)
    scene = Scene("pull", bodies, 1.0, gravity=still, springs=(spring,), clock=SECOND)
    motion = roll(scene, method, substeps)
    reduced = 1.0 * 3.0 / 4.0
    decay = 1.0 / (2.0 * reduced)
    beat = math.sqrt(30.0 / reduced - decay**2)
    phase = beat * motion.time
    exact = 0.2 * np.exp(-decay * motion.time) * (np.cos(phase) + decay / beat * np.sin(phase))
    apart = motion.position[0, :, 1, 0] - motion.position[0, :, 0, 0] - 0.8
    np.testing.assert_allclose(apart, exact, rtol=0, atol=near)


@pytest.mark.parametrize("top", ["hinge", "ball"])
@pytest.mark.parametrize("back", ["hinge", "ball"])
def test_closed_loop(top: JointKind, back: JointKind) -> None:
    scene = four_bar(top, back)
    coarse, fine = (roll(scene, EULER, n, error_reduction=0.5) for n in (40, 80))
    exact = four_bar_angle(fine.time)
    errors = [np.abs(turned(motion, 0) - exact).max() for motion in (coarse, fine)]
    assert errors[1] < 2e-3
    assert 0.8 < math.log2(errors[0] / errors[1]) < 1.2
    np.testing.assert_allclose(turned(fine, 2), turned(fine, 0), rtol=0, atol=1e-5)
    assert np.abs(fine.position[..., 1]).max() < 1e-6


def test_torque_on_a_hinge_that_closes_a_loop() -> None:
    scene = four_bar("hinge", "hinge", torque=3.0)
    assert Mechanism.of(scene).loops[0].name == "back"
    motion = roll(scene, EULER, 80, error_reduction=0.5)
    exact = four_bar_angle(motion.time, 3.0)
    np.testing.assert_allclose(turned(motion, 0), exact, rtol=0, atol=2e-3)


def test_torque_on_a_hinge_turns_both_bodies() -> None:
    bodies = tuple(
        Body(name, inertia=Inertia(1.0, (0.3, moment, 0.3)))
        for name, moment in (("a", 0.2), ("b", 0.5))
    )
    hinge = Joint("motor", "hinge", "a", "b", (0.0, 0.0, 0.0), axis=Y)
    scene = Scene("motor", bodies, 1.0, joints=(hinge,), torques=(Torque("motor", (0.3,)),))
    motion = roll(scene, RK4, 1)
    np.testing.assert_allclose(turned(motion, 0), -0.5 * 0.3 / 0.2 * motion.time**2, atol=1e-10)
    np.testing.assert_allclose(turned(motion, 1), 0.5 * 0.3 / 0.5 * motion.time**2, atol=1e-10)


def test_fixed_loop_holds() -> None:
    bar = tuple(Body(name, inertia=BRICK) for name in ("a", "b"))
    joints = (
        Joint("hang", "hinge", "world", "a", (0.0, 0.0, 0.0), axis=Y),
        Joint("first", "fixed", "a", "b", (0.3, 0.0, 0.0)),
        Joint("second", "fixed", "a", "b", (0.0, 0.0, 0.3)),
    )
    scene = Scene("twice", bar, 1.0, joints=joints, clock=SECOND)
    alone = Scene("once", bar, 1.0, joints=joints[:2], clock=SECOND)
    got, expected = (roll(each, EULER, 20) for each in (scene, alone))
    np.testing.assert_allclose(got.position, expected.position, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("method", "order"), [(RK4, 4), (EULER, 1)])
def test_order_of_convergence(method: str, order: int) -> None:
    scene = load_scene("5pendulum")
    assert ENGINE.methods[method].order_for(scene) == order
    batch = draw_batch(scene, [0]).truncated(25)
    ends = []
    for substeps in (4, 8, 16):
        with ENGINE.open(scene, Settings(method, 0.02 / substeps)) as run:
            ends.append(run.rollout(batch).position[0, -1])
    coarse, fine = (np.abs(b - a).max() for a, b in pairwise(ends))
    assert abs(math.log2(coarse / fine) - order) < 0.2


@pytest.mark.parametrize("name", ["6pendulum", "2ladder"])
def test_the_engine_holds_the_scene(name: str) -> None:
    scene = load_scene(name)
    batch = draw_batch(scene, [2]).truncated(1)
    settings = ENGINE.settings(scene, "matched")
    with ENGINE.open(scene, settings) as run:
        assert compare(Mechanism.of(scene), batch, settings, run.readback(batch)) == []
        motion = run.rollout(batch)
    for key in ("position", "orientation", "velocity", "angular_velocity"):
        np.testing.assert_allclose(
            getattr(motion, key)[:, 0], getattr(batch, key), rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("scene", [four_bar("ball", "hinge"), held("slider", OBLIQUE)])
def test_axes_are_read_back(scene: Scene) -> None:
    batch, settings = draw_batch(scene, [0]), Settings(EULER, 0.001)
    with ENGINE.open(scene, settings) as run:
        read = run.readback(batch)
    assert compare(Mechanism.of(scene), batch, settings, read) == []
    assert read.joint_axis is not None
    assert np.isfinite(read.joint_axis).any()


def test_coordinates_are_what_the_engine_moves() -> None:
    """Body states made from DART's coordinates agree with DART's own, in the midst of a motion."""
    scene = load_scene("2ladder")
    batch = draw_batch(scene, [2]).truncated(10)
    with ENGINE.open(scene, Settings(EULER, 0.001)) as run:
        motion = run.rollout(batch)
        bodies = run._model.bodies  # type: ignore[attr-defined]
        places = np.array([body.getCOM() for body in bodies])
        speeds = np.array([body.getCOMLinearVelocity() for body in bodies])
        spins = np.array([body.getAngularVelocity() for body in bodies])
    np.testing.assert_allclose(motion.position[0, -1], places, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.velocity[0, -1], speeds, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.angular_velocity[0, -1], spins, rtol=0, atol=1e-9)


def test_the_same_batch_gives_the_same_bits() -> None:
    scene = load_scene("2ladder")
    batch = draw_batch(scene, [0, 1]).truncated(3)
    with ENGINE.open(scene, Settings(EULER, 0.001)) as run:
        first, second, alone = run.rollout(batch), run.rollout(batch), run.rollout(batch[[1]])
    assert np.array_equal(first.position, second.position)
    assert np.array_equal(first.velocity[[1]], alone.velocity)


def test_a_blow_up_ends_its_trajectory_only(capfd: pytest.CaptureFixture[str]) -> None:
    scene = load_scene("6pendulum")
    batch = draw_batch(scene, [2, 0]).truncated(100)
    batch.velocity[0] *= 1e3
    batch.angular_velocity[0] *= 1e3
    with ENGINE.open(scene, Settings(EULER, 0.02)) as run:
        motion = run.rollout(batch)
    failure = motion.failures[0]
    assert failure is not None
    assert np.isnan(motion.position[0, failure.frame :]).all()
    assert np.isfinite(motion.position[0, : failure.frame]).all()
    assert motion.failures[1] is None
    assert np.isfinite(motion.position[1]).all()
    assert capfd.readouterr().err == ""


def test_the_listing_runs_by_itself() -> None:
    scene = four_bar("hinge", "ball")
    with ENGINE.open(scene, Settings(EULER, 0.001)) as run:
        text = run.native(draw_batch(scene, [0]))
    names: dict[str, Any] = {}
    exec(text, names)
    assert names["skeleton"].getMass() == 3.5
    seen = [names["bodies"][k].getShapeNode(0).getVisualAspect() for k in range(len(scene.bodies))]
    assert all(aspect is not None for aspect in seen)


def test_process_wide_parameters_are_put_back() -> None:
    loop = dartpy.constraint.BallJointConstraint
    before = loop.getErrorReductionParameter()
    roll(four_bar("hinge", "ball"), EULER, 20, error_reduction=0.7)
    assert loop.getErrorReductionParameter() == before


def test_what_it_cannot_do_is_refused() -> None:
    points = ((0.0, 0.0, 1.0), (0.15, 0.0, 0.0))
    link = DistanceLink("link", ("world", "brick"), points)
    tied = Scene("tied", (Body("brick", inertia=BRICK),), 1.0, distance_links=(link,))
    with pytest.raises(Unsupported, match="distance"):
        ENGINE.open(tied, Settings(EULER, 0.001))
    with pytest.raises(Unsupported, match="solves no constraints"):
        ENGINE.open(load_scene("2ladder"), Settings(RK4, 0.001))
    with pytest.raises(InputError, match="error_reduction"):
        ENGINE.open(load_scene("2ladder"), Settings(EULER, 0.001, {"error_reduction": 1.5}))


def test_closing_frees_the_engine_at_once() -> None:
    run = ENGINE.open(load_scene("2ladder"), Settings(EULER, 0.001))
    world = weakref.ref(run._model.world)  # type: ignore[attr-defined]
    gc.disable()
    try:
        run.close()
        assert world() is None
    finally:
        gc.enable()
    run.close()
