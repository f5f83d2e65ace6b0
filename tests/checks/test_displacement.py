from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks import Finding, Record
from mbds_xsim.checks.displacement import displacement
from mbds_xsim.checks.ground import pushes_of
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Ground, Inertia, Joint, Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import simulate as run
from tests.over_ground import over_ground

RK4 = Method("RK4", "RK4", 4)
LEAPFROG = Method("Euler", "semi-implicit Euler", 1, velocity_lag=-0.5)
MASS, RADIUS, MU, FRAME = 2.0, 0.1, 0.43, 0.02
MOMENT = 0.4 * MASS * RADIUS**2


def of_case(case: Any, motion: Trajectory) -> Finding:
    return displacement.finding(Record(case.scene, case.batch, motion, RK4, 1e-3))


def ball(frames: int) -> Scene:
    body = Body("ball", inertia=Inertia(MASS, (MOMENT,) * 3), position=(0.0, 0.0, RADIUS))
    return over_ground(body, body.position, RADIUS, Ground(MU, 0.5), clock=Clock(FRAME, frames))


def rolled(impulses: Array, times: Array, speed: float, rate: float) -> tuple[Scene, Trajectory]:
    """A ball that the ground pushes at given times of each frame, by (along x, up) [N·s].

    Shapes (frame, push, 2) and (frame, push), times as shares of the frame, ascending.
    """
    x, z, v, w, u, turn = 0.0, RADIUS, speed, rate, 0.0, 0.0
    rows = [(x, z, v, u, turn, w)]
    for pushes, moments in zip(impulses, times, strict=True):
        last = 0.0
        for (along, up), moment in [*zip(pushes, moments, strict=True), ((0.0, 0.0), 1.0)]:
            span = FRAME * (moment - last)
            x, turn = x + span * v, turn + span * w
            z, u, last = z + span * u - 0.5 * 9.81 * span**2, u - 9.81 * span, moment
            v, u, w = v + along / MASS, u + up / MASS, w - RADIUS * along / MOMENT
        rows.append((x, z, v, u, turn, w))
    x, z, v, u, turn, w = np.array(rows).T
    zero = np.zeros_like(x)
    scene = ball(len(impulses))
    motion = Trajectory(
        np.arange(len(rows)) * np.float64(FRAME),
        np.stack([x, zero, z], axis=-1)[None, :, None],
        rotation.from_vector(np.stack([zero, turn, zero], axis=-1))[None, :, None],
        np.stack([v, zero, u], axis=-1)[None, :, None],
        np.stack([zero, w, zero], axis=-1)[None, :, None],
        (None,),
    )
    return scene, motion


def judged(scene: Scene, motion: Trajectory) -> Finding:
    return displacement.finding(Record(scene, draw_batch(scene, [0]), motion, RK4, 1e-3))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), pushes=st.integers(1, 5), rough=st.floats(0.0, 1.0))
def test_no_course_of_contact_within_the_cone_is_blamed(
    seed: int, pushes: int, rough: float
) -> None:
    """The ground may push at any time between two frames, as often as it likes, if it is near."""
    draw, frames = np.random.default_rng(seed), 12
    height, climb, totals = 0.0, 0.0, []
    for kick in rough * draw.uniform(0.0, 9.81 * FRAME, frames):
        gain = max(0.0, 9.81 * FRAME - climb - height / FRAME) + kick * (height < 0.002)
        totals.append(MASS * gain)
        height += FRAME * (climb + 0.5 * gain) - 0.5 * 9.81 * FRAME**2
        climb += gain - 9.81 * FRAME
    up = draw.dirichlet(np.ones(pushes), frames) * np.array(totals)[:, None]
    along = up * draw.uniform(-MU, MU, up.shape)
    times = np.sort(draw.uniform(0.0, 1.0, up.shape), axis=1)
    scene, motion = rolled(np.stack([along, up], axis=-1), times, draw.normal(), draw.normal())

    record = Record(scene, draw_batch(scene, [0]), motion, RK4, 1e-3)
    (push,) = pushes_of(record)
    assume(push.reach.all())

    assert displacement.finding(record).passed.all()


@pytest.fixture(scope="module")
def slides() -> tuple[Scene, Trajectory]:
    """A ball that slides until it rolls, for 0.6 s in all."""
    frames, parts = 30, 200
    up = np.full((frames, parts), MASS * 9.81 * FRAME / parts)
    times = (np.arange(parts) + 0.5) / parts * np.ones((frames, 1))
    stops = 2.0 / 7.0 * 3.0 / (MU * 9.81)
    slips = FRAME * (np.arange(frames)[:, None] + times) < stops
    return rolled(np.stack([-MU * up * slips, up], axis=-1), times, 3.0, 0.0)


def drifting(motion: Trajectory) -> Trajectory:
    position = motion.position + 0.5 * motion.time[:, None, None] * np.array([1.0, 0.0, 0.0])
    return dataclasses.replace(motion, position=position)


def shaken(motion: Trajectory) -> Trajectory:
    position = motion.position.copy()
    noise = np.random.default_rng(1).normal(0.0, 1e-3, (*position.shape[:2], 1, 2))
    position[:, 1:, :, :2] += noise[:, 1:]
    return dataclasses.replace(motion, position=position)


def late(motion: Trajectory) -> Trajectory:
    before = np.maximum(np.arange(len(motion.time)) - 1, 0)
    return dataclasses.replace(
        motion, position=motion.position[:, before], orientation=motion.orientation[:, before]
    )


def repeated(motion: Trajectory, frame: int, until: int | None = None) -> Trajectory:
    """Record everything after `frame` a frame late, or let it stand still."""
    frames = np.arange(len(motion.time))
    picks = np.where(frames > frame, frames - 1 if until is None else frame, frames)
    names = ("position", "orientation", "velocity", "angular_velocity")
    return dataclasses.replace(motion, **{name: getattr(motion, name)[:, picks] for name in names})


def twisting(motion: Trajectory, rate: float = 0.1) -> Trajectory:
    """Twist the last body about its own axis, in addition to its recorded rate."""
    turn = rotation.from_vector(np.array([0.0, 0.0, rate]) * motion.time[:, None])
    facing = motion.orientation.copy()
    facing[:, :, -1] = rotation.multiply(facing[:, :, -1], turn)
    return dataclasses.replace(motion, orientation=facing)


def told_to_twist(motion: Trajectory, rate: float = 0.1) -> Trajectory:
    spin = motion.angular_velocity.copy()
    spin[:, :, -1] += rotation.rotate(motion.orientation[:, :, -1], np.array([0.0, 0.0, rate]))
    return dataclasses.replace(motion, angular_velocity=spin)


FAULTS: dict[str, Callable[[Trajectory], Trajectory]] = {
    "drift": drifting,
    "noise": shaken,
    "late": late,
    "last frame twice": lambda motion: repeated(motion, len(motion.time) - 2),
    "a frame twice, the rest late": lambda motion: repeated(motion, 8),
    "frozen": lambda motion: repeated(motion, 8, until=8),
    "twist": twisting,
    "rate without twist": told_to_twist,
}


def test_a_ball_that_slides_is_not_blamed(slides: tuple[Scene, Trajectory]) -> None:
    finding = judged(*slides)

    assert finding.passed.all()
    # The frame in which it stops slipping is the worst.
    assert 0.01 < finding.figure[0] < 0.5


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_lasting_contact_shows(slides: tuple[Scene, Trajectory], fault: str) -> None:
    scene, motion = slides

    assert not judged(scene, FAULTS[fault](motion)).passed.any()


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_smooth_motion_shows(
    pendulum: Any, tumbling: Any, linkage: Any, fault: str
) -> None:
    for case in (pendulum, tumbling, linkage):
        sound, broken = (
            of_case(case, motion) for motion in (case.exact, FAULTS[fault](case.exact))
        )

        assert sound.passed.all()
        assert (sound.figure < 0.7).all()
        assert not broken.passed.any(), (case.scene.name, broken.figure)


def test_a_method_that_lags_as_it_declares_passes(pendulum: Any, simulate: Any) -> None:
    motion = simulate(pendulum.scene, pendulum.batch, 8, "euler_reduced")
    finding = displacement.finding(
        Record(pendulum.scene, pendulum.batch, motion, LEAPFROG, FRAME / 8)
    )

    assert finding.passed.all()


def test_a_turn_that_changes_in_the_last_frame_is_not_blamed() -> None:
    """A rod's rate changes evenly over three frames by chance, but not in the last one."""
    scene = load_scene("3ladder")
    batch, adapter = draw_batch(scene, [56], seed=1), load_adapter("exudyn")
    chosen = Settings("generalised-alpha", 0.004)
    motion = run(scene, batch, "exudyn", chosen).trajectory
    record = Record(scene, batch, motion, adapter.methods[chosen.method], chosen.step)
    assert displacement.finding(record).passed.all()


def test_what_is_at_rest_may_repeat() -> None:
    scene = ball(10)
    facing = np.broadcast_to(rotation.IDENTITY, (1, 11, 1, 4))
    zero = np.zeros((1, 11, 1, 3))
    place = zero + np.array([0.0, 0.0, RADIUS])
    motion = Trajectory(np.arange(11) * np.float64(FRAME), place, facing, zero, zero, (None,))

    assert judged(scene, motion).figure.tolist() == [0.0]
    spinning = dataclasses.replace(motion, angular_velocity=zero + np.array([0.0, 0.0, 0.2]))
    finding = judged(scene, spinning)
    assert not finding.passed.any()
    assert finding.where[0].endswith("turn of ball")


def test_frames_after_a_failure_are_left_out(pendulum: Any) -> None:
    velocity = pendulum.exact.velocity.copy()
    velocity[0, 9:] = np.nan
    velocity[1, 1:] = np.nan
    velocity[2] = np.nan
    with np.errstate(all="raise"):
        finding = of_case(pendulum, dataclasses.replace(pendulum.exact, velocity=velocity))

    assert np.isnan(finding.series[0, 9:]).all()
    assert finding.passed.tolist() == [True, True, False]


def test_rounding_of_a_steady_turn_is_no_delay() -> None:
    """Spins grow in their last digits, which the recorded turns do not show yet."""
    joint = Joint("pin", "hinge", "world", "rod", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), rate=0.5)
    inertia = Inertia(1.0, (0.1, 0.1, 0.1))
    scene = Scene("turning", (Body("rod", inertia=inertia),), 1.0, joints=(joint,), clock=Clock())
    batch = draw_batch(scene, [0])
    motion = solve(scene, batch, cache=False)
    spin = motion.angular_velocity.copy()
    spin[:, :, 0, 0] += 1e-17 * np.arange(spin.shape[1])

    noisy = dataclasses.replace(motion, angular_velocity=spin)
    finding = displacement.finding(Record(scene, batch, noisy, RK4, 1e-3))
    assert finding.figure.max() < 0.1


@pytest.mark.parametrize("stop", [0.3, 0.4, 0.5, 0.6])
def test_a_joint_thrown_off_its_stop_within_a_frame_is_not_blamed(stop: float) -> None:
    """An arm's shoulder rests on its stop until the elbow meets its own."""
    rod = Inertia(0.05, (1e-6, 4e-5, 4e-5))
    bodies = tuple(Body(k, inertia=rod, position=(x, 0, 0)) for k, x in (("a", 0.05), ("b", 0.15)))
    axis = (0.0, -1.0, 0.0)
    joints = (
        Joint("shoulder", "hinge", "world", "a", (0, 0, 0), axis, 0.0, 0.0, limits=(0.0, 2.0)),
        Joint("elbow", "hinge", "a", "b", (0.1, 0, 0), axis, 0.2, 20.0, limits=(-2.0, stop)),
    )
    scene = Scene("arm", bodies, 0.2, joints=joints, clock=Clock(FRAME, 10))
    motion = solve(scene, draw_batch(scene, [0]))
    loose = tuple(msgspec.structs.replace(joint, limits=None) for joint in joints)

    assert judged(scene, motion).passed.all()
    if stop == 0.5:  # the ends of the frame do not show this impact
        unaware = msgspec.structs.replace(scene, joints=loose)
        assert not judged(unaware, motion).passed.any()


def test_a_whip_within_a_frame_is_not_blamed() -> None:
    """A heavy arm swings a light one round its end, which frames of 60 ms hardly show."""
    rods = Inertia(1.0, (1e-3, 0.02, 0.02)), Inertia(0.02, (1e-6, 1e-5, 1e-5))
    bodies = (
        Body("arm", inertia=rods[0], position=(0.25, 0.0, 0.0)),
        Body("lash", inertia=rods[1], position=(0.52, 0.0, 0.0)),
    )
    y = (0.0, 1.0, 0.0)
    joints = (
        Joint("shoulder", "hinge", "world", "arm", (0, 0, 0), y, 0.0, 10.0),
        Joint("tip", "hinge", "arm", "lash", (0.5, 0, 0), y, 2.8, 0.0),
    )
    scene = Scene("whip", bodies, 0.6, joints=joints, clock=Clock(0.06, 17))
    motion = solve(scene, draw_batch(scene, [0]), cache=False)

    assert judged(scene, motion).figure[0] < 0.7
    for fault in ("drift", "late", "frozen"):
        assert not judged(scene, FAULTS[fault](motion)).passed.any()


@pytest.mark.parametrize("blow", [0.1, 0.25, 0.5])
def test_a_joint_that_falls_back_on_its_stop_within_a_frame_is_not_blamed(blow: float) -> None:
    """A hammer throws a sledge up, which is at rest at its top at the end of the frame."""
    share, hit = 0.02, (2 + blow) * FRAME
    speed = 9.81 * FRAME * (1 - blow) * (1 + share) / share
    start, way = speed + 9.81 * hit, speed * hit + 0.5 * 9.81 * hit**2
    z = (0.0, 0.0, 1.0)
    bodies = (
        Body("sledge", inertia=Inertia(1.0, (0.1,) * 3)),
        Body("hammer", inertia=Inertia(share, (0.1 * share,) * 3)),
    )
    joints = (
        Joint("rail", "slider", "world", "sledge", (0, 0, 0), z, 0.0, 0.0, limits=(0.0, 1.0)),
        Joint("bolt", "slider", "sledge", "hammer", (0, 0, 0), z, 0.0, start, limits=(-1.0, way)),
    )
    scene = Scene("hop", bodies, 1.0, joints=joints, clock=Clock(FRAME, 10))
    motion = solve(scene, draw_batch(scene, [0]), cache=False)
    rise = 0.5 * 9.81 * (FRAME * (1 - blow)) ** 2

    assert np.abs(motion.velocity[0, :, 0]).max() < 1e-9
    assert np.allclose(motion.position[0, :, 0, 2], rise * (np.arange(11) == 3), atol=1e-9)
    assert judged(scene, motion).figure[0] < 0.9
    risen = motion.position.copy()
    risen[0, 3, 0, 2] = 0.01
    assert not judged(scene, dataclasses.replace(motion, position=risen)).passed.any()
