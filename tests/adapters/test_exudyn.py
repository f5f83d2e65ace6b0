"""Exudyn's peculiarities, and exact answers on small scenes."""

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
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    Force,
    Inertia,
    Joint,
    Scene,
    SpringDamper,
    Torque,
)
from mbds_xsim.scene.servo import Servo
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.readback import compare
from mbds_xsim.simulate.registry import load_adapter, load_scene

pytest.importorskip("exudyn")

ENGINE = load_adapter("exudyn")
IMPLICIT = ("trapezoidal", "generalised-alpha")
CLOCK = Clock(frame=0.02, steps=50)
_RODS = (("upper", 0.05), ("lower", 0.15))


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


def brick(name: str, com: tuple[float, float, float] = (0.0, 0.0, 0.0), **more: Any) -> Body:
    """Make a lopsided brick: no principal axis lies along the body frame."""
    shape = Inertia(2.0, (0.05, 0.08, 0.1), (0.01, -0.005, 0.02), com)
    return Body(name, inertia=shape, **more)


def one_body(body: Body, **more: Any) -> Scene:
    return Scene(name="one", bodies=(body,), length=1.0, clock=CLOCK, **more)


def integrated(rate: Callable[[float, Array], Array], start: list[float], time: Array) -> Array:
    span = (0.0, float(time[-1]))
    return solve_ivp(rate, span, start, "DOP853", time, rtol=1e-12, atol=1e-13).y


def tumbling_error(method: str, substeps: int, spin: tuple[float, float, float]) -> float:
    """Largest angle between the engine's orientation and that of Euler's equations [rad]."""
    scene = one_body(brick("brick", angular_velocity=spin), gravity=(0.0, 0.0, 0.0))
    motion = roll(scene, method, substeps)
    inertia = Mechanism.of(scene).inertia[0]

    def rate(_: float, y: Array) -> Array:
        q, w = y[:4], y[4:]
        dq = 0.5 * rotation.multiply(q, np.array([0.0, *w]))
        return np.concatenate([dq, np.linalg.solve(inertia, -np.cross(w, inertia @ w))])

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
            differences = compare(Mechanism.of(scene), batch, changed, run.readback(batch))
        assert [line.split(" of ")[0] for line in differences] == [
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


@pytest.mark.parametrize("method", IMPLICIT)
def test_a_joint_may_have_dry_friction_and_stops_at_once(method: str) -> None:
    rail = Joint(
        "rail", "slider", "world", "cart", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0),
        rate=0.0, friction=1.0, limits=(-1.0, 0.25),
    )  # fmt: skip
    cart, push = Body("cart", inertia=Inertia(2.0, (0.1,) * 3)), Force("cart", ((3.0, 0.0, 0.0),))
    scene = Scene("pushed", (cart,), 1.0, joints=(rail,), forces=(push,), clock=CLOCK)
    batch, settings = draw_batch(scene, [0]), Settings(method, 0.02 / 40)
    with ENGINE.open(scene, settings) as run:
        differences = compare(Mechanism.of(scene), batch, settings, run.readback(batch))
    motion = roll(scene, method, 40)

    assert not differences
    x = np.minimum(0.5 * (3.0 - 1.0) / 2.0 * motion.time**2, 0.25)
    np.testing.assert_allclose(motion.position[0, :, 0, 0], x, atol=1e-3)


@pytest.mark.parametrize("method", IMPLICIT)
def test_a_joint_leaves_its_stop_where_another_meets_one(method: str) -> None:
    """The elbow's impact throws the shoulder of an arm with rods of 50 g off its stop.

    All torques are far below 1 N·m, the error that Exudyn's solver accepts by default.
    """
    rod = Inertia(0.05, (1e-6, 4e-5, 4e-5))
    bodies = tuple(Body(n, inertia=rod, position=(x, 0, 0)) for n, x in _RODS)
    rows = (("shoulder", "world", "upper", 0.0, 0.0, 0.0, (0.0, 2.0)),
            ("elbow", "upper", "lower", 0.1, 0.2, 20.0, (-2.0, 0.9)))  # fmt: skip
    joints = tuple(
        Joint(name, "hinge", parent, child, (x, 0, 0), (0, -1, 0), start, rate, limits=limits)
        for name, parent, child, x, start, rate, limits in rows
    )
    scene = Scene("arm", bodies, 0.2, joints=joints, clock=Clock(frame=0.02, steps=10))

    motion = roll(scene, method, 80)

    exact = reference.solve(scene, draw_batch(scene, [0]))
    assert np.ptp(exact.position[0, :6, 0, 2]) > 5e-3  # it is thrown off
    np.testing.assert_allclose(motion.position, exact.position, atol=1e-4)


@pytest.mark.parametrize("geared", [True, False])
def test_a_stop_holds_all_that_gears_and_loops_move(geared: bool) -> None:
    """A light wheel or crank stops, and with it a heavy slider or rocker that it moves."""
    y, light = (0.0, 1.0, 0.0), Inertia(0.1, (0.002,) * 3)
    joints = [
        Joint("stop", "hinge", "world", "light", (0, 0, 0), y, rate=2.0, limits=(-2.0, 0.5)),
        Joint("other", "slider" if geared else "hinge", "world", "heavy", (0.5, 0, 0), y),
    ]
    bodies = [
        Body("light", inertia=light, position=(0, 0, 0.15)),
        Body("heavy", inertia=Inertia(3.0, (0.05,) * 3), position=(0.5, 0, 0.15)),
    ]
    gears = (Coupling("other", "stop", 0.3),) if geared else ()
    if not geared:
        bodies.append(Body("rod", inertia=light, position=(0.25, 0, 0.3)))
        joints.append(Joint("pin", "hinge", "light", "rod", (0, 0, 0.3), y))
        joints.append(Joint("close", "hinge", "rod", "heavy", (0.5, 0, 0.3), y))
    scene = Scene(
        "stop",
        tuple(bodies),
        1.0,
        gravity=(0, 0, 0),
        joints=tuple(joints),
        couplings=gears,
        clock=Clock(0.02, 50),
    )

    motion = roll(scene, "generalised-alpha", 80)

    exact = reference.solve(scene, draw_batch(scene, [0]))
    np.testing.assert_allclose(motion.position, exact.position, atol=2e-3)


def test_a_joint_at_a_centre_of_mass_is_that_of_any_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a centre of mass the engine gets the body's node, whose position needs no rotation."""
    scene = load_scene("2ladder")
    scene = msgspec.structs.replace(scene, clock=CLOCK)
    by_nodes = roll(scene, "generalised-alpha", 4)
    monkeypatch.setattr("mbds_xsim_adapters.exudyn.model._OFFSET", 0.0)

    by_points = roll(scene, "generalised-alpha", 4)

    assert np.abs(by_nodes.position - by_points.position).max() < 1e-12
    assert np.abs(by_nodes.orientation - by_points.orientation).max() < 1e-12


@pytest.mark.parametrize(
    "law", [{"stiffness": 3.0, "rest": 3.0}, {"limits": (0.0, 4.0)}, {}], ids=str
)
@pytest.mark.parametrize(("start", "rate"), [(math.pi, 0.0), (3.1415, 2.0)])
def test_a_hinge_may_start_at_half_a_turn(start: float, rate: float, law: dict[str, Any]) -> None:
    pin = Joint("pin", "hinge", "world", "arm", (0, 0, 0), (0, 1, 0), start=start, rate=rate, **law)
    arm = Body("arm", inertia=Inertia(1.0, (0.02,) * 3), position=(0.0, 0.0, -0.5))
    servo = Servo("pin", (3.3,), (0.0,), 5.0, 0.2, 1, 4.0)
    clock = Clock(frame=0.02, steps=10)
    scene = Scene("arm", (arm,), 0.5, joints=(pin,), servos=() if law else (servo,), clock=clock)

    batch, settings = draw_batch(scene, [0]), ENGINE.settings(scene, "matched")
    with ENGINE.open(scene, settings) as run:
        motion = run.rollout(batch)
        assert "SetDataCoordinates" in run.native(batch)

    exact = reference.solve(scene, batch, cache=False)
    assert np.abs(motion.position - exact.position).max() < 1e-6
