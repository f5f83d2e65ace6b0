from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.checks import Record
from mbds_xsim.checks.displacement import displacement
from mbds_xsim.checks.kinematics import kinematics, velocity_lag
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Ground, Inertia, Joint, Scene
from mbds_xsim.scene.state import Failure, Trajectory
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate as run
from mbds_xsim.testing.case import Case as Exact
from mbds_xsim.testing.cases import CASES
from tests.over_ground import over_ground

LEAPFROG = Method("Euler", "semi-implicit Euler", 1, velocity_lag=-0.5)
METHODS = {
    "rk4": Method("RK4", "RK4", 4),
    "midpoint": Method("midpoint", "trapezoidal", 2),
    "euler_reduced": LEAPFROG,
}


def _both(record: Record) -> tuple[Any, Any]:
    return kinematics.finding(record), velocity_lag.finding(record)


def _record(case: Any, motion: Trajectory, method: Method, substeps: int) -> Record:
    return Record(case.scene, case.batch, motion, method, case.scene.clock.frame / substeps)


def test_an_exact_motion_agrees_with_itself(pendulum: Any, tumbling: Any, linkage: Any) -> None:
    for case in (pendulum, tumbling, linkage):
        speeds, lag = _both(_record(case, case.exact, METHODS["rk4"], 1000))

        assert speeds.passed.all()
        assert lag.passed.all()
        # Frames of 20 ms resolve a tenth of a microsecond.
        assert (lag.figure < 2e-7).all()
        assert (lag.uncertainty < 1e-6).all()


@pytest.mark.parametrize("stepper", METHODS)
@pytest.mark.parametrize("substeps", [4, 20])
def test_methods_pass_with_the_lag_they_declare(
    pendulum: Any, simulate: Any, stepper: str, substeps: int
) -> None:
    motion = simulate(pendulum.scene, pendulum.batch, substeps, stepper)
    speeds, lag = _both(_record(pendulum, motion, METHODS[stepper], substeps))

    assert speeds.passed.all()
    assert lag.passed.all()
    assert (lag.figure < 0.01 * pendulum.scene.clock.frame / substeps).all()


def test_a_lag_that_is_not_declared_shows(pendulum: Any, simulate: Any) -> None:
    motion = simulate(pendulum.scene, pendulum.batch, 20, "euler_reduced")
    silent = dataclasses.replace(LEAPFROG, velocity_lag=0.0)
    _, lag = _both(_record(pendulum, motion, silent, 20))
    _, reverse = _both(
        _record(pendulum, motion, dataclasses.replace(LEAPFROG, velocity_lag=0.5), 20)
    )

    assert not lag.passed.any()
    assert np.allclose(lag.figure, 0.5e-3, rtol=0.02)
    assert np.allclose(reverse.figure, 1e-3, rtol=0.02)


@pytest.fixture(scope="module", params=METHODS)
def halves(request: Any, pendulum: Any, simulate: Any) -> tuple[str, Trajectory, Trajectory]:
    """A motion in steps of 1 ms, recorded in time and one step late."""
    scene, batch = pendulum.scene, pendulum.batch
    on_time, late = (simulate(scene, batch, 20, request.param, late=delay) for delay in (0.0, 1e-3))
    return request.param, on_time, late


@pytest.mark.parametrize("late", ["position", "velocity", "both"])
def test_frames_half_a_step_late_show(
    pendulum: Any, halves: tuple[str, Trajectory, Trajectory], late: str
) -> None:
    """Frames are half a step late in positions alone, in velocities alone, or in both."""
    stepper, on_time, delayed = halves
    method, count = METHODS[stepper], 10
    names = {
        "position": ("position", "orientation"),
        "velocity": ("velocity", "angular_velocity"),
    }
    fields = names.get(late) or (*names["position"], *names["velocity"])
    motion = dataclasses.replace(on_time, **{name: getattr(delayed, name) for name in fields})
    half = dataclasses.replace(method, velocity_lag=method.velocity_lag / 2)
    speeds, lag = _both(_record(pendulum, motion, half, count))

    assert not (speeds.passed & lag.passed).any()
    if late == "both":
        # Late together they agree with one another, but not with the start.
        assert lag.passed.all()
        assert (speeds.frame == 1).all()
    else:
        assert np.allclose(lag.figure, 1e-3, rtol=0.05)


def test_velocities_of_another_body_or_in_another_frame_show(tumbling: Any) -> None:
    exact = tumbling.exact
    swapped = dataclasses.replace(exact, velocity=exact.velocity[:, :, ::-1])
    back = rotation.conjugate(exact.orientation)
    local = dataclasses.replace(
        exact, angular_velocity=rotation.rotate(back, exact.angular_velocity)
    )
    for broken in (swapped, local):
        speeds, _ = _both(_record(tumbling, broken, METHODS["rk4"], 10))
        assert not speeds.passed.any()
        assert (speeds.figure > 0.01).all()


def test_a_single_wrong_frame_is_named(pendulum: Any) -> None:
    position = pendulum.exact.position.copy()
    position[1, 12, 0] += 1e-4
    broken = dataclasses.replace(pendulum.exact, position=position)
    speeds, _ = _both(_record(pendulum, broken, METHODS["rk4"], 10))

    assert speeds.passed.tolist() == [True, False, True]
    # A frame is an end of one of the steps that are looked at.
    assert speeds.frame[1] in (12, 13)


def _wheel(rate: float) -> Scene:
    return Scene(
        name="wheel",
        gravity=(0.0, 0.0, 0.0),
        bodies=(Body("wheel", inertia=Inertia(1.0, (0.1, 0.1, 0.2)), position=(0.1, 0.0, 0.0)),),
        joints=(Joint("axle", "hinge", "world", "wheel", (0, 0, 0), (0.0, 0.0, 1.0), rate=rate),),
        length=0.3,
        clock=Clock(0.02, 10),
    )


@pytest.mark.parametrize("turns", [0.05, 0.3, 3.0])
def test_what_frames_do_not_resolve_is_no_mismatch(turns: float) -> None:
    """A wheel makes a part of a turn, or several turns, in each frame."""
    rate = turns * 2 * np.pi / 0.02
    scene = _wheel(rate)
    angle = rate * 0.02 * np.arange(11)
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=-1)
    facing = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)
    motion = Trajectory(
        np.arange(11) * np.float64(0.02),
        0.1 * out[None, :, None],
        facing[None, :, None],
        0.1 * rate * along[None, :, None],
        np.broadcast_to([0.0, 0.0, rate], (1, 11, 1, 3)),
        (None,),
    )
    speeds, lag = _both(Record(scene, draw_batch(scene, [0]), motion, METHODS["rk4"], 0.02 / 1e3))

    assert speeds.passed.all()
    assert lag.passed.all()
    late = dataclasses.replace(
        motion, velocity=0.1 * rate * np.roll(along, 1, axis=0)[None, :, None]
    )
    speeds, lag = _both(Record(scene, draw_batch(scene, [0]), late, METHODS["rk4"], 0.02 / 1e3))

    # A delay of a frame shows where frames resolve the turn at all.
    assert (speeds.passed & lag.passed).all() == (turns > 1)


@pytest.mark.parametrize(
    ("name", "frame"), [("2pendulum", 0.5), ("2ladder", 0.1), ("3ladder", 0.3)]
)
def test_frames_too_far_apart_to_show_the_motion_raise_no_alarm(name: str, frame: float) -> None:
    """In some of these frames two formulas agree by chance, which proves nothing."""
    scene = msgspec.structs.replace(load_scene(name), clock=Clock(frame, int(6.0 / frame)))
    batch = draw_batch(scene, range(6), noise=False)
    exact = reference.solve(scene, batch, cache=False)
    record = Record(scene, batch, exact, METHODS["rk4"], 1e-3)

    assert kinematics.finding(record).passed.all()
    assert displacement.finding(record).passed.all()


def test_a_body_is_resolved_no_better_than_those_it_hangs_with() -> None:
    """At frame 113 the quintic's correction of the first link is small by chance, yet wrong."""
    scene = load_scene("6pendulum")
    scene = msgspec.structs.replace(scene, clock=Clock(scene.clock.frame, 116))
    batch = draw_batch(scene, [2], seed=9007)
    exact = reference.solve(scene, batch, cache=False)

    finding = kinematics.finding(Record(scene, batch, exact, METHODS["rk4"], step=1e-4))

    assert finding.figure[0] < 2e-5  # of 1e-4


def test_a_motion_without_acceleration_has_no_lag() -> None:
    scene = Scene(
        name="drifter",
        gravity=(0.0, 0.0, 0.0),
        bodies=(Body("drifter", inertia=Inertia(1.0, (0.1, 0.1, 0.1)), velocity=(1.0, 0.0, 0.0)),),
        length=1.0,
        clock=Clock(0.02, 4),
    )
    batch = draw_batch(scene, [0])
    time = np.arange(5) * np.float64(0.02)
    zero = np.zeros((1, 5, 1, 3))
    position, velocity = zero.copy(), zero.copy()
    position[..., 0], velocity[..., 0] = time[:, None], 1.0
    facing = np.broadcast_to(rotation.IDENTITY, (1, 5, 1, 4))
    motion = Trajectory(time, position, facing, velocity, zero, (None,))
    for speed in (1.0, 0.0):
        moved = dataclasses.replace(motion, position=speed * position, velocity=speed * velocity)
        speeds, lag = _both(Record(scene, batch, moved, METHODS["rk4"], 1e-3))
        assert speeds.figure.tolist() == [pytest.approx(0.0, abs=1e-12)]
        assert lag.passed.all()
        assert lag.figure.tolist() == [0.0]
    stopped = dataclasses.replace(motion, velocity=zero)
    speeds, _ = _both(Record(scene, batch, stopped, METHODS["rk4"], 1e-3))
    assert not speeds.passed.any()


@pytest.mark.parametrize("frames", [1, 2])
def test_frames_that_follow_rest_are_held_to_the_speed_they_reach(frames: int) -> None:
    """A stone is let go, and each step that the check looks at begins at rest."""
    body = Body("stone", inertia=Inertia(1.0, (0.1, 0.1, 0.1)), position=(0.0, 0.0, 1.0))
    scene = Scene("stone", (body,), 1.0, clock=Clock(0.02, frames))
    batch = draw_batch(scene, [0])
    exact = reference.solve(scene, batch, cache=False)

    speeds, _ = _both(Record(scene, batch, exact, METHODS["rk4"], 1e-4))

    assert speeds.passed.all()
    slow = dataclasses.replace(exact, velocity=0.9 * exact.velocity)
    speeds, _ = _both(Record(scene, batch, slow, METHODS["rk4"], 1e-4))
    assert 0.01 < speeds.figure[0] < 0.1


def test_rates_that_change_by_rounding_alone_have_no_lag() -> None:
    """A cart with a wheel that is out of true by 1e-20 m."""
    inertia = Inertia(1.0, (0.1, 0.1, 0.2))
    wheel = Body("wheel", inertia=inertia, position=(0.0, 1e-20, 0.0))
    joints = (
        Joint("rail", "slider", "world", "cart", (0, 0, 0), (1.0, 0.0, 0.0)),
        Joint("axle", "hinge", "cart", "wheel", (0, 0, 0), (0.0, 0.0, 1.0), rate=1.0),
    )
    bodies, still = (Body("cart", inertia=inertia), wheel), (0.0, 0.0, 0.0)
    scene = Scene("cart", bodies, 0.3, gravity=still, joints=joints, clock=Clock(0.02, 10))
    batch = draw_batch(scene, [0])
    exact = reference.solve(scene, batch, cache=False)

    _, lag = _both(Record(scene, batch, exact, METHODS["rk4"], 1e-4))

    assert lag.figure[0] < 1e-9
    assert lag.uncertainty[0] < 1e-9


def test_a_link_without_moments_of_inertia_turns_as_exactly_as_any() -> None:
    """The pendulum consists of a point-mass link and a rod."""
    hollow, rod = Inertia(1.0, (1e-34,) * 3), Inertia(0.5, (0.01, 0.01, 0.001))
    bodies = tuple(
        Body(name, inertia=inertia, position=(place, 0.0, 0.0))
        for name, inertia, place in (("link", hollow, 0.1), ("rod", rod, 0.4))
    )
    joints = (
        Joint("shoulder", "hinge", "world", "link", (0, 0, 0), (0.0, 1.0, 0.0), 0.0, 1.0),
        Joint("elbow", "hinge", "link", "rod", (0.2, 0, 0), (1.0, 1.0, 0.0), 0.0, 3.0),
    )
    scene = Scene("hollow", bodies, 0.6, joints=joints, clock=Clock(0.02, 20))
    batch = draw_batch(scene, [0])
    exact = reference.solve(scene, batch, cache=False)

    speeds, lag = _both(Record(scene, batch, exact, METHODS["rk4"], 1e-4))

    assert speeds.figure[0] < 1e-6
    assert lag.uncertainty[0] < 1e-6
    assert lag.passed.all()


def test_frames_after_a_failure_are_left_out(pendulum: Any) -> None:
    velocity = pendulum.exact.velocity.copy()
    velocity[0, 9:] = np.nan
    velocity[1, 1:] = np.nan
    broken = dataclasses.replace(pendulum.exact, velocity=velocity)
    with np.errstate(all="raise"):
        speeds, lag = _both(_record(pendulum, broken, METHODS["rk4"], 10))

    assert np.isnan(speeds.series[0, 9:]).all()
    assert speeds.passed.tolist() == [True, False, True]
    assert lag.passed.tolist() == [True, False, True]


def test_only_flights_are_looked_at_where_there_is_contact() -> None:
    """One sphere drops from 1.1 m and bounces at 0.1 m; another lies on the ground."""
    fall = np.sqrt(2 / 9.81)
    ball = Body("ball", inertia=Inertia(1.0, (0.1, 0.1, 0.1)), position=(0.0, 0.0, 1.1))
    scene = over_ground(ball, ball.position, 0.1, Ground(0.0, 1.0), clock=Clock(0.02, 80))
    time = np.arange(81) * np.float64(0.02)
    since = (time + fall) % (2 * fall) - fall
    position, velocity = np.zeros((2, 2, 81, 1, 3))
    position[0, :, 0, 2], position[1, ..., 2] = 1.1 - 0.5 * 9.81 * since**2, 0.1
    velocity[0, :, 0, 2] = -9.81 * since
    facing = np.broadcast_to(rotation.IDENTITY, (2, 81, 1, 4))
    motion = Trajectory(time, position, facing, velocity, np.zeros((2, 81, 1, 3)), (None, None))
    batch = draw_batch(scene, [0, 1])
    speeds, lag = _both(Record(scene, batch, motion, METHODS["rk4"], 1e-3))

    assert (speeds.figure < 1e-12).all()
    assert (lag.figure < 1e-12).all()
    late = dataclasses.replace(motion, velocity=velocity + np.array([0.0, 0.0, 9.81 * 0.5e-3]))
    _, lag = _both(Record(scene, batch, late, METHODS["rk4"], 1e-3))
    assert lag.figure == pytest.approx([0.5e-3, 0.0])
    assert lag.passed.tolist() == [False, True]
    assert kinematics(Record(scene, batch[[1]], motion[[1]])) is None
    assert velocity_lag(Record(scene, batch[[1]], motion[[1]])) is None


_TOLD = {("exudyn", "leaning rod", "generalised-alpha", 5e-3, "displacement")}
"""True alarms: after the impact the rod rests to 10 nm, but with velocities of 5 mm/s."""


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_no_engine_raises_a_false_alarm(adapter: Adapter, case: Exact) -> None:
    batch = draw_batch(case.scene, [0])
    for name, method in adapter.methods.items():
        # All pass at 0.1 ms too, which costs more than all the rest.
        for step in (5e-3, 1e-3, 2.5e-4)[: 2 if method.order >= 4 else 3]:
            if not adapter.refusals(case.scene, name):
                motion = run(case.scene, batch, adapter.name, Settings(name, step)).trajectory
                record = Record(case.scene, batch, motion, method, step)
                for check in (kinematics, velocity_lag, displacement):
                    result = check.finding(record)
                    due = (adapter.name, case.name, name, step, result.check) in _TOLD
                    assert result.passed.all() != due, (name, step, result.line(0), result.frame)


@pytest.mark.parametrize("name", ["ball loop", "Hooke's joint"])
def test_only_impulses_of_loops_explain_another_start(name: str) -> None:
    """Impulses that close loops at steps of 5 ms explain a start's velocities; others do not."""
    scene = next(case.scene for case in CASES if case.name == name)
    batch = draw_batch(scene, [0])
    motion = reference.solve(scene, batch)
    mechanism = Mechanism.of(scene)
    still = dataclasses.replace(LEAPFROG, velocity_lag=0.0)
    record = Record(scene, batch, motion, still)
    start = record.bodies[:, 0]
    joints = tuple(joint for joint in mechanism.joints if joint not in mechanism.loops)
    tree = dataclasses.replace(mechanism, joints=joints, loops=())
    load = batch.force[:, 0], batch.torque[:, 0]
    closed, loose = (reference.accelerations(each, start, *load) for each in (mechanism, tree))

    def figure(late: float, times: float) -> Any:
        """Check a start whose velocities lack impulses of `late` [s], or are `times` as large."""
        velocity, spin = motion.velocity.copy(), motion.angular_velocity.copy()
        velocity[:, 0] = times * velocity[:, 0] - late * (closed[0] - loose[0])
        spin[:, 0] = times * spin[:, 0] - late * (closed[1] - loose[1])
        begun = dataclasses.replace(motion, velocity=velocity, angular_velocity=spin)
        return kinematics(Record(scene, batch, begun, still, 5e-3))

    assert figure(2.5e-3, 1.0).passed.all()
    for wrong in (figure(0.0, 1.01), figure(2.5e-3, 1.01), figure(15e-3, 1.0)):
        assert not wrong.passed.any()
        assert wrong.frame.tolist() == [1]


def test_a_closed_mechanism_that_blew_up_at_once_has_figures_of_nothing() -> None:
    scene = next(case.scene for case in CASES if case.name == "parallelogram")
    batch = draw_batch(scene, [0])
    lost = (Failure(1, "a body's speed passes all bounds"),)
    motion = dataclasses.replace(reference.solve(scene, batch), failures=lost).cut_at_failures()

    finding = kinematics(Record(scene, batch, motion, METHODS["rk4"], 5e-3))

    assert finding is None or not np.isfinite(finding.figure).any()
