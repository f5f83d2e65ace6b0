"""Exudyn's own ways, and exact answers on small scenes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, UnknownName, Unsupported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    GRAVITY,
    Body,
    Clock,
    DistanceLink,
    Force,
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

pytest.importorskip("exudyn")

ENGINE = load_adapter("exudyn")
IMPLICIT = ("trapezoidal", "generalised-alpha")
EXPLICIT = ("RK44", "RK67")
G = -GRAVITY[2]
CLOCK = Clock(frame=0.02, steps=50)
TIMES: Array = np.linspace(0.0, CLOCK.duration, CLOCK.steps + 1)


def roll(scene: Scene, method: str, substeps: int, **options: Any) -> Trajectory:
    settings = Settings(method, scene.clock.frame / substeps, options)
    with ENGINE.open(scene, settings) as run:
        trajectory = run.rollout(draw_batch(scene, [0]))
    assert trajectory.failures == (None,)
    return trajectory


def errors(
    scene: Scene, method: str, exact: Callable[[Trajectory], Array], substeps: tuple[int, ...]
) -> list[float]:
    """Largest deviation of all frames from the exact answer, for each number of steps a frame."""
    return [float(np.abs(exact(roll(scene, method, n))).max()) for n in substeps]


def assert_second_order(coarse: float, fine: float) -> None:
    assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.2)


def brick(name: str, com: tuple[float, float, float] = (0.0, 0.0, 0.0), **more: Any) -> Body:
    """Lopsided: no principal axis along the body frame."""
    shape = Inertia(2.0, (0.05, 0.08, 0.1), (0.01, -0.005, 0.02), com)
    return Body(name, inertia=shape, **more)


def one_body(body: Body, **more: Any) -> Scene:
    return Scene(name="one", bodies=(body,), length=1.0, clock=CLOCK, **more)


def about(axis: tuple[float, float, float], body: Body, anchor: Array) -> float:
    """Moment of inertia of a body about a line through an anchor [kg·m²]."""
    mechanism = Mechanism.of(one_body(body))
    unit = np.array(axis) / np.linalg.norm(axis)
    arm = mechanism.com[0] - anchor
    off = float(arm @ arm - (arm @ unit) ** 2)
    return float(unit @ mechanism.inertia[0] @ unit + mechanism.mass[0] * off)


def integrated(rate: Callable[[float, Array], Array], start: list[float], time: Array) -> Array:
    span = (0.0, float(time[-1]))
    return solve_ivp(rate, span, start, "DOP853", time, rtol=1e-12, atol=1e-13).y


def hinge_angle(motion: Trajectory, axis: Array) -> Array:
    return np.unwrap(rotation.angle_about(motion.orientation[0, :, 0], axis))


@pytest.mark.parametrize("method", [*IMPLICIT, *EXPLICIT])
def test_free_mass_under_stepped_force_is_exact(method: str) -> None:
    # Second order is exact for constant forces: an input late by a step would show at 1e-4.
    rng = np.random.default_rng(0)
    series = rng.normal(size=(CLOCK.steps, 3))
    forced = Force("brick", tuple(map(tuple, series.tolist())))
    scene = one_body(brick("brick", velocity=(1.0, 2.0, 3.0)), forces=(forced,))
    motion = roll(scene, method, 4)
    acceleration = series / 2.0 + np.array(GRAVITY)
    velocity = np.array([1.0, 2.0, 3.0]) + CLOCK.frame * np.cumsum(acceleration, axis=0)
    assert np.abs(motion.velocity[0, 1:, 0] - velocity).max() < 1e-12
    mean = np.concatenate([[[1.0, 2.0, 3.0]], velocity])
    position = CLOCK.frame * np.cumsum((mean[1:] + mean[:-1]) / 2, axis=0)
    assert np.abs(motion.position[0, 1:, 0] - position).max() < 1e-12


def tumbling_error(method: str, substeps: int, spin: tuple[float, float, float]) -> float:
    """Angle between the engine's and the exact orientation [rad], Euler's equations."""
    scene = one_body(brick("brick", angular_velocity=spin), gravity=(0.0, 0.0, 0.0))
    motion = roll(scene, method, substeps)
    inertia = Mechanism.of(scene).inertia[0]

    def rate(_: float, y: Array) -> Array:
        q, w = y[:4], y[4:]
        turned = 0.5 * rotation.multiply(q, np.array([0.0, *w]))
        return np.concatenate([turned, np.linalg.solve(inertia, -np.cross(w, inertia @ w))])

    exact = integrated(rate, [1.0, 0.0, 0.0, 0.0, *spin], motion.time)[:4].T
    off = rotation.multiply(rotation.conjugate(exact), motion.orientation[0, :, 0])
    return float(np.linalg.norm(rotation.to_vector(off), axis=-1).max())


@pytest.mark.parametrize(("method", "order"), [(m, 2) for m in IMPLICIT] + [("RK44", 4)])
def test_tumbling_brick_converges_past_many_turns(method: str, order: int) -> None:
    # Ten rad in a second: the rotation vector passes its singularity at 2π.
    coarse, fine = (tumbling_error(method, n, (0.5, 10.0, 0.3)) for n in (4, 8))
    assert math.log2(coarse / fine) == pytest.approx(order, abs=0.2)


def test_rk67_tumbles_to_rounding() -> None:
    assert tumbling_error("RK67", 4, (0.5, 10.0, 0.3)) < 1e-9


@pytest.mark.parametrize("method", IMPLICIT)
def test_oblique_hinge_meets_pendulum_equation(method: str) -> None:
    axis, com = (0.0, 1.0, 0.5), (0.3, 0.0, 0.0)
    body = brick("brick", com)
    scene = one_body(body, joints=(Joint("hinge", "hinge", "world", "brick", (0, 0, 0), axis),))
    unit = np.array(axis) / np.linalg.norm(axis)
    moment = about(axis, body, np.zeros(3))

    def rate(_: float, y: Array) -> Array:
        arm = rotation.rotate(rotation.from_vector(y[0] * unit), np.array(com))
        return np.array([y[1], unit @ np.cross(arm, 2.0 * np.array(GRAVITY)) / moment])

    exact = integrated(rate, [0.0, 0.0], TIMES)[0]
    assert_second_order(
        *errors(scene, method, lambda motion: hinge_angle(motion, unit) - exact, (4, 8))
    )


@pytest.mark.parametrize("method", IMPLICIT)
def test_slider_falls_along_its_line(method: str) -> None:
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    joint = Joint("slider", "slider", "world", "brick", (0, 0, 0), (1.0, 2.0, -2.0), rate=0.5)
    motion = roll(one_body(brick("brick", (0.1, 0.2, 0.3)), joints=(joint,)), method, 2)
    along = 0.5 * motion.time + 0.5 * (axis @ np.array(GRAVITY)) * motion.time**2
    exact = np.array([0.1, 0.2, 0.3]) + along[:, None] * axis
    assert np.abs(motion.position[0, :, 0] - exact).max() < 1e-10
    assert np.abs(motion.orientation[0, :, 0] - rotation.IDENTITY).max() < 1e-10


@pytest.mark.parametrize("method", IMPLICIT)
def test_fixed_pair_swings_as_one_body(method: str) -> None:
    bodies = (brick("inner", (0.3, 0.0, 0.0)), brick("outer", (0.7, 0.0, 0.1)))
    joints = (
        Joint("hinge", "hinge", "world", "inner", (0, 0, 0), (0.0, 1.0, 0.0)),
        Joint("weld", "fixed", "inner", "outer", (0.5, 0.0, 0.0)),
    )
    scene = Scene(name="pair", bodies=bodies, joints=joints, length=1.0, clock=CLOCK)
    axis = np.array([0.0, 1.0, 0.0])
    moment = sum(about((0.0, 1.0, 0.0), body, np.zeros(3)) for body in bodies)

    def rate(_: float, y: Array) -> Array:
        turn = rotation.from_vector(y[0] * axis)
        pull = sum(
            np.cross(rotation.rotate(turn, arm), 2.0 * np.array(GRAVITY))
            for arm in Mechanism.of(scene).com
        )
        return np.array([y[1], axis @ pull / moment])

    exact = integrated(rate, [0.0, 0.0], TIMES)[0]

    def off(motion: Trajectory) -> Array:
        together = np.abs(motion.orientation[0, :, 0] - motion.orientation[0, :, 1])
        assert together.max() < 1e-9
        return hinge_angle(motion, axis) - exact

    assert_second_order(*errors(scene, method, off, (4, 8)))


@pytest.mark.parametrize("method", IMPLICIT)
def test_distance_link_makes_a_spherical_pendulum(method: str) -> None:
    link = DistanceLink("link", ("world", "brick"), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    body = brick("brick", (1.0, 0.0, 0.0), velocity=(0.0, 1.5, 0.0))
    scene = one_body(body, distance_links=(link,))

    def rate(_: float, y: Array) -> Array:
        x, v, g = y[:3], y[3:], np.array(GRAVITY)
        return np.concatenate([v, g - (x @ g + v @ v) / (x @ x) * x])

    start = [1.0, 0.0, 0.0, 0.0, 1.5, 0.0]
    exact = integrated(rate, start, TIMES)[:3].T
    assert_second_order(
        *errors(scene, method, lambda motion: motion.position[0, :, 0] - exact, (4, 8))
    )


@pytest.mark.parametrize(("method", "order"), [(m, 2) for m in IMPLICIT] + [("RK44", 4)])
def test_spring_and_damper_meet_the_oscillator(method: str, order: int) -> None:
    stiffness, damping, mass = 80.0, 0.8, 2.0
    spring = SpringDamper(
        "spring", ("world", "brick"), ((0, 0, 0), (1.0, 0, 0)), stiffness, damping, 0.8
    )
    body = brick("brick", (1.0, 0.0, 0.0))
    scene = one_body(body, springs=(spring,), gravity=(0.0, 0.0, 0.0))
    rate = damping / (2 * mass)
    frequency = math.sqrt(stiffness / mass - rate**2)

    def off(motion: Trajectory) -> Array:
        t = motion.time
        phase = np.cos(frequency * t) + rate / frequency * np.sin(frequency * t)
        return motion.position[0, :, 0, 0] - 0.8 - 0.2 * np.exp(-rate * t) * phase

    coarse, fine = errors(scene, method, off, (1, 2))
    assert math.log2(coarse / fine) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize("method", IMPLICIT)
def test_hinge_torque_acts_on_both_bodies(method: str) -> None:
    # In free flight a flywheel about a principal axis of both turns exactly by I α = ± τ.
    moments = {"frame": (1.0, 1.2, 0.9), "wheel": (0.1, 0.2, 0.1)}
    bodies = tuple(Body(name, inertia=Inertia(1.0, value)) for name, value in moments.items())
    hinge = Joint("axle", "hinge", "frame", "wheel", (0, 0, 0), (0.0, 1.0, 0.0))
    torque = Torque("axle", (0.3, -0.5, 0.2), hold=10)
    scene = Scene(
        name="flywheel", bodies=bodies, joints=(hinge,), torques=(torque,), length=1.0, clock=CLOCK
    )
    motion = roll(scene, method, 2)
    held = np.array([0.3, -0.5] + [0.2] * 3).repeat(10)
    impulse = np.concatenate([[0.0], CLOCK.frame * np.cumsum(held)])
    assert np.abs(motion.angular_velocity[0, :, 1, 1] - impulse / 0.2).max() < 1e-9
    assert np.abs(motion.angular_velocity[0, :, 0, 1] + impulse / 1.2).max() < 1e-9


def parallelogram() -> Scene:
    """Two cranks and a coupler on four parallel hinges: three of the rows are redundant."""
    crank = Inertia(1.0, (0.02, 0.02, 0.02), com=(0.0, 0.0, -0.2))
    bodies = (
        Body("left", inertia=crank),
        Body("right", inertia=crank, position=(0.5, 0.0, 0.0)),
        Body("coupler", inertia=Inertia(2.0, (0.1, 0.1, 0.1), com=(0.25, 0.0, -0.4))),
    )
    places = {
        ("world", "left"): (0.0, 0.0, 0.0),
        ("world", "right"): (0.5, 0.0, 0.0),
        ("left", "coupler"): (0.0, 0.0, -0.4),
        ("right", "coupler"): (0.5, 0.0, -0.4),
    }
    joints = tuple(
        Joint(f"{a}_{b}", "hinge", a, b, at, (0, 1, 0), start=0.8 if b == "left" else None)
        for (a, b), at in places.items()
    )
    return Scene(name="parallelogram", bodies=bodies, joints=joints, length=1.0, clock=CLOCK)


@pytest.mark.parametrize("method", IMPLICIT)
def test_redundant_loop_swings_as_a_pendulum(method: str) -> None:
    # The coupler only translates: one pendulum of inertia Σ (I + m r²) over the cranks and m L².
    moment = 2 * (0.02 + 1.0 * 0.2**2) + 2.0 * 0.4**2
    weight = G * (2 * 1.0 * 0.2 + 2.0 * 0.4)
    exact = integrated(
        lambda _, y: np.array([y[1], -weight / moment * math.sin(y[0])]),
        [0.8, 0.0],
        TIMES,
    )[0]
    axis = np.array([0.0, 1.0, 0.0])
    assert_second_order(
        *errors(parallelogram(), method, lambda motion: hinge_angle(motion, axis) - exact, (4, 8))
    )


def driven_tree() -> Scene:
    """A branching tree on skew axes, one joint listed child first, with every kind of load."""
    bodies = (
        brick("a", (0.2, 0.0, 0.1)),
        brick("b", (0.5, 0.1, 0.1), orientation=(0.5, 0.5, 0.5, 0.5)),
        brick("c", (0.9, 0.0, 0.1)),
    )
    joints = (
        Joint("turn", "hinge", "world", "a", (0, 0, 0), (1.0, 1.0, 0.0), start=0.4, rate=1.0),
        Joint("push", "slider", "b", "a", (0.3, 0, 0), (0.0, 1.0, 1.0), start=0.1, rate=-0.5),
        Joint("swing", "hinge", "a", "c", (0.7, 0, 0), (0.0, 1.0, -1.0), start=-0.3),
    )
    springs = (
        SpringDamper("inner", ("b", "c"), ((0.5, 0, 0.2), (0.9, 0.1, 0)), 40.0, 0.5),
        SpringDamper("outer", ("world", "a"), ((0, 0, 1), (0.2, 0, 0)), 40.0, 0.5, 0.7),
    )
    return Scene(
        name="driven",
        bodies=bodies,
        joints=joints,
        springs=springs,
        forces=(Force("b", ((1.0, 0.0, 2.0), (0.0, -3.0, 0.0)), hold=7),),
        torques=(Torque("swing", (0.4, -0.4, 0.2), hold=5), Torque("turn", (0.5,))),
        length=1.0,
        clock=CLOCK,
    )


@pytest.mark.parametrize(
    ("method", "order"), [(method, 2) for method in IMPLICIT] + [("tree-RK44", 4)]
)
def test_driven_tree_converges_to_the_reference(method: str, order: int) -> None:
    scene = driven_tree()
    exact = reference.solve(scene, draw_batch(scene, [0]), rtol=1e-12, cache=False)
    coarse, fine = errors(
        scene, method, lambda motion: motion.position[0] - exact.position[0], (4, 8)
    )
    assert math.log2(coarse / fine) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize("method", ["trapezoidal", "tree-RK44"])
def test_native_model_is_the_scene(method: str) -> None:
    scene = driven_tree()
    settings = Settings(method, CLOCK.frame / 4)
    batch = draw_batch(scene, [0])
    with ENGINE.open(scene, settings) as run:
        assert compare(Mechanism.of(scene), batch, settings, run.readback(batch)) == []
        assert run.size.coordinates == (3 if method == "tree-RK44" else 18)
        listing, size = run.native(batch), run.size
        motion = run.rollout(batch)
    assert np.abs(motion.position[0, 0] - batch.position[0]).max() < 1e-12
    assert np.abs(motion.velocity[0, 0] - batch.velocity[0]).max() < 1e-12
    alone: dict[str, Any] = {}
    exec(listing, alone)
    if method == "trapezoidal":
        drawn = [alone["mbs"].GetObjectParameter(k, "VgraphicsData") for k in alone["bodies"]]
        assert all(drawn)
    assert alone["mbs"].systemData.ODE2Size() == size.coordinates


def test_readback_sees_a_changed_model() -> None:
    scene = driven_tree()
    settings = ENGINE.settings(scene, "matched")
    batch = draw_batch(scene, [0])
    for method in ("trapezoidal", "tree-RK44"):
        changed = Settings(method, settings.step)
        with ENGINE.open(heavier(scene), changed) as run:
            found = compare(Mechanism.of(scene), batch, changed, run.readback(batch))
        assert [line.split(" of ")[0] for line in found] == [
            "mass [kg]",
            "inertia [kg·m²]",
            "gravity [m/s²]",
        ]


def heavier(scene: Scene) -> Scene:
    change = msgspec.structs.replace
    other = Inertia(2.02, (0.05, 0.08, 0.11), (0.01, -0.005, 0.02), (0.5, 0.1, 0.1))
    bodies = tuple(
        change(body, inertia=other) if body.name == "b" else body for body in scene.bodies
    )
    return change(scene, bodies=bodies, gravity=(0.0, 0.0, -9.8))


def test_batch_rows_do_not_touch_each_other() -> None:
    scene = load_scene("5pendulum")
    batch = draw_batch(scene, [0, 1, 2]).truncated(10)
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        together, again = run.rollout(batch), run.rollout(batch[[2]])
    assert np.array_equal(together.position[2], again.position[0])
    assert np.array_equal(together.angular_velocity[2], again.angular_velocity[0])


def test_solver_that_gives_up_ends_its_trajectory_alone(capfd: pytest.CaptureFixture[str]) -> None:
    # Generalised-alpha without damping is unstable on index-3 constraints.
    scene = load_scene("6pendulum")
    batch = draw_batch(scene, [2, 0])
    settings = Settings("generalised-alpha", 0.002, {"spectral_radius": 1.0})
    with ENGINE.open(scene, settings) as run:
        motion = run.rollout(batch)
    failure = motion.failures[0]
    assert failure is not None
    assert "Newton" in failure.reason
    assert np.isfinite(motion.position[0, : failure.frame]).all()
    assert np.isnan(motion.position[0, failure.frame :]).all()
    assert capfd.readouterr() == ("", "")


def test_wrong_requests_are_one_clear_line() -> None:
    scene = load_scene("5pendulum")
    with pytest.raises(Unsupported, match=r"exudyn RK44 cannot do ball joint: .*constraints"):
        ENGINE.open(scene, Settings("RK44", 0.002))
    with pytest.raises(UnknownName, match=r"linear_solver of exudyn .*'LU'.* EigenSparse"):
        ENGINE.open(scene, Settings("trapezoidal", 0.002, {"linear_solver": "LU"}))
    with pytest.raises(InputError, match="spectral_radius of exudyn: got 2"):
        ENGINE.open(scene, Settings("generalised-alpha", 0.002, {"spectral_radius": 2}))


def test_matched_takes_a_rule_that_ends_where_constraints_are_redundant() -> None:
    for name, method in (("2ladder", "trapezoidal"), ("workbench", "generalised-alpha")):
        assert ENGINE.settings(load_scene(name), "matched").method == method
