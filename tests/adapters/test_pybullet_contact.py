"""PyBullet on the ground, against exact answers and the reference."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Scene, Torque
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing.contact_cases import RADIUS as R
from mbds_xsim.testing.contact_cases import ball, crate, gaps, rolling
from tests.adapters.exact import Runs

pytest.importorskip("pybullet")

ENGINE = load_adapter("pybullet")
METHOD = "semi-implicit-euler"
Vector = tuple[float, float, float]
G = 9.81
MU, E = 0.43, 0.9332
STILL = (0.0, 0.0, 0.0)
HEADINGS = [0.0, 0.4, math.pi / 4, 2.0]


def careful(steps_per_frame: int, **options: float) -> Settings:
    return Settings(METHOD, 0.02 / steps_per_frame, options)


CAREFUL = {
    "ballscroll": careful(40),
    "balldrop": careful(200),
    "simplecubli": careful(320, solver_iterations=50),
}
"""Finer than matched, for the laws that contact keeps to."""


def carefully(scene: Scene, batch: Batch) -> Trajectory:
    with ENGINE.open(scene, CAREFUL[scene.name]) as run:
        return run.rollout(batch)


simulate = Runs(ENGINE, {}).stepped


def distance(one: Trajectory, other: Trajectory) -> Array:
    """Between the first bodies [m], shape (trajectory, frame)."""
    return np.asarray(np.linalg.norm(one.position - other.position, axis=-1)[..., 0])


@pytest.mark.parametrize("noise", [False, True])
def test_ballscroll_keeps_to_the_reference_at_every_interval(noise: bool) -> None:
    scene = load_scene("ballscroll")
    batch = draw_batch(scene, range(6), noise=noise)
    motion = carefully(scene, batch)
    assert motion.failures == (None,) * 6
    assert distance(motion, reference.solve(scene, batch, cache=False)).max() < 6e-4
    assert np.abs(gaps(scene, motion)).max() < 1e-9


@pytest.mark.parametrize("noise", [False, True])
def test_balldrop_keeps_to_the_reference_through_its_bounces(noise: bool) -> None:
    scene = load_scene("balldrop")
    batch = draw_batch(scene, range(6), noise=noise)
    exact, motion = reference.solve(scene, batch, cache=False), carefully(scene, batch)
    assert motion.failures == (None,) * 6
    error = distance(motion, exact)
    for row, climb in enumerate(exact.velocity[:, :, 0, 2]):
        # A frame of free fall changes the climb by 0.2 m/s only.
        first, second, third = (np.flatnonzero(np.diff(climb) > 0.0) + 1)[:3]
        assert error[row, :first].max() < 5e-4
        assert error[row, first:third].max() < 1.2e-2
        heights = [
            run.position[row, first:second, 0, 2]
            + run.velocity[row, first:second, 0, 2] ** 2 / 2 / G
            for run in (motion, exact)
        ]
        assert np.abs(heights[0] / heights[1] - 1.0).max() < 3e-3
    assert gaps(scene, motion).min() > -1e-3


def test_a_ball_slides_then_rolls_alike_in_every_direction() -> None:
    case = rolling()
    options = ENGINE.settings(case.scene, "matched").options
    with ENGINE.open(case.scene, Settings(METHOD, 5e-4, options)) as run:
        motion = run.rollout(case.batch)
    # Semi-implicit Euler is half a step of braking off.
    off = np.abs(motion.position - case.exact.position).max(axis=(0, 2, 3))
    assert np.all(off <= 1.1 * case.drift * 5e-4 / 2 + 1e-5)
    end, spin = motion.velocity[:, -1, 0], motion.angular_velocity[:, -1, 0]
    np.testing.assert_allclose(end, case.exact.velocity[:, -1, 0], atol=1e-6)
    assert np.abs(end + np.cross(spin, [0.0, 0.0, -R])).max() < 1e-6


@pytest.mark.parametrize("speed", [1e-3, 0.02, 0.1, 1.0, 10.0])
def test_restitution_does_not_depend_on_the_speed_of_impact(speed: float) -> None:
    scene = ball(height=1e-3 * speed, velocity=(0.0, 0.0, -speed), steps=1)
    weightless = msgspec.structs.replace(scene, gravity=STILL)
    # What the overlap adds as it is pushed out is a step over a second of the speed.
    climb = simulate(weightless, 200).velocity[0, -1, 0, 2]
    assert climb == pytest.approx(E * speed, rel=2e-4, abs=1.1e-6 / 1e-4 * (speed < 0.02))


@pytest.mark.parametrize("tilt", HEADINGS)
def test_a_crate_rests_where_it_stands(tilt: float) -> None:
    scene = crate(tilt=tilt)
    motion = simulate(scene, 20)
    assert np.abs(motion.position - motion.position[:, :1]).max() < 1e-9
    assert np.abs(motion.velocity).max() < 1e-6


def test_a_ball_at_rest_stays_at_rest() -> None:
    motion = simulate(ball(), 20)
    assert np.abs(motion.position - motion.position[:, :1]).max() < 1e-12


@pytest.mark.parametrize("heading", [0.0, math.pi / 4])
def test_a_crate_slides_as_far_as_friction_lets_it(heading: float) -> None:
    along = np.array([math.cos(heading), math.sin(heading), 0.0])
    motion = simulate(crate(velocity=tuple(2.0 * along), ground=Ground(MU, 0.0)), 100)
    way = motion.position[0, -1, 0] - motion.position[0, 0, 0]
    np.testing.assert_allclose(way, 2.0**2 / (2 * MU * G) * along, atol=3e-4)
    assert np.abs(motion.angular_velocity).max() < 1e-3


def test_a_crate_comes_down_flat_and_rests_on_its_corners() -> None:
    scene = crate(height=0.1, ground=Ground(MU, 0.5), steps=200)
    motion = simulate(scene, 50)
    lowest = np.sort(gaps(scene, motion)[0, -1])[:4]
    assert np.abs(lowest).max() < 1e-5
    assert np.abs(motion.velocity[0, -1]).max() < 1e-6


def _corner(arm: Array, velocity: Vector) -> Scene:
    """A body of 1 kg and 0.02 kg·m² with one sphere, whose lowest point is at `arm` (x, z)."""
    at = (0.0, 0.0, 1e-3 - float(arm[1]))
    centre = (float(arm[0]), 0.0, R + 1e-3)
    body = Body("a", inertia=Inertia(1.0, (0.02,) * 3), position=at, velocity=velocity)
    return Scene(
        "probe",
        (body,),
        length=1.0,
        gravity=STILL,
        contacts=(ContactSphere("a", centre, R),),
        ground=Ground(MU, E),
        clock=Clock(steps=1),
    )


def _impulse(arm: Array, velocity: Array) -> Array:
    """Of Newton's restitution with Coulomb's friction on such a body, x and z [N·s]."""
    turn = np.array([arm[1], -arm[0]])  # what unit spin about y gives the point
    compliance = np.eye(2) + np.outer(turn, turn) / 0.02
    stick = np.linalg.solve(compliance, [-velocity[0], -(1 + E) * velocity[1]])
    if abs(stick[0]) <= MU * stick[1]:
        return np.asarray(stick)
    slip = np.array([math.copysign(MU, stick[0]), 1.0])
    return np.asarray(-(1 + E) * velocity[1] / (compliance @ slip)[1] * slip)


@pytest.mark.parametrize(
    ("arm", "velocity", "gains"),
    [
        ((0.1, -0.2), (0.3, -1.0), False),  # sticks
        ((0.1, -0.2), (-3.0, -1.0), False),  # slips
        ((0.2, -0.2), (1.0, -1.0), False),
        ((0.2, -0.2), (-1.0, -1.0), True),
    ],
)
def test_an_eccentric_impact_is_newtons_and_coulombs_even_where_they_give_energy(
    arm: tuple[float, float], velocity: tuple[float, float], gains: bool
) -> None:
    """Newton's law with friction is known to create energy in some of these (Kane 1984)."""
    at, before = np.array(arm), np.array(velocity)
    motion = simulate(_corner(at, (velocity[0], 0.0, velocity[1])), 2000)
    impulse = _impulse(at, before)
    after, spin = before + impulse, (at[1] * impulse[0] - at[0] * impulse[1]) / 0.02
    np.testing.assert_allclose(motion.velocity[0, 1, 0, [0, 2]], after, atol=1e-3)
    np.testing.assert_allclose(motion.angular_velocity[0, 1, 0], [0.0, spin, 0.0], atol=1e-2)
    rise = (after @ after + 0.02 * spin**2) / (before @ before) - 1.0
    assert (rise > 0.02) == gains


def test_torques_drive_the_car() -> None:
    """The wheels roll: the torques carry its mass and the wheels' inertia, with no slip."""
    car = load_scene("particlecar")
    names = [joint.name for joint in car.joints]
    scene = msgspec.structs.replace(
        car,
        name="probe",
        sampling=(),
        noise=0.0,
        clock=Clock(steps=100),
        torques=tuple(Torque(name, (3.0,)) for name in names),
    )
    motion = simulate(scene, 40)
    mechanism = Mechanism.of(scene)
    moment = mechanism.inertia[1:, 1, 1].sum()
    acceleration = 4 * 3.0 / 0.2 / (mechanism.mass.sum() + moment / 0.2**2)
    assert motion.velocity[0, -1, 0, 0] == pytest.approx(2.0 * acceleration, rel=1e-6)
    np.testing.assert_allclose(
        motion.angular_velocity[0, -1, 1:, 1] * 0.2, 2.0 * acceleration, rtol=1e-6
    )
    assert np.abs(motion.position[0, :, :, 2] - motion.position[0, :1, :, 2]).max() < 1e-6


def test_the_car_rolls_on_at_a_hundred_radians_a_second() -> None:
    car = load_scene("particlecar")
    joints = tuple(msgspec.structs.replace(joint, rate=100.0) for joint in car.joints)
    bodies = (
        msgspec.structs.replace(car.bodies[0], velocity=(20.0, 0.0, 0.0), angular_velocity=STILL),
        *car.bodies[1:],
    )
    scene = msgspec.structs.replace(
        car, name="probe", sampling=(), joints=joints, bodies=bodies, noise=0.0
    )
    motion = simulate(scene, 40)
    np.testing.assert_allclose(
        motion.position[0, -1, :, 0] - motion.position[0, 0, :, 0], 80.0, rtol=1e-9
    )
    np.testing.assert_allclose(motion.angular_velocity[0, :, 1:, 1], 100.0, rtol=1e-8)


def test_drawn_cars_converge_and_do_not_depend_on_the_solvers_sweeps() -> None:
    """With contacts that begin at no gap, wheels that touch drop out by rounding: 0.4 m off."""
    scene = load_scene("particlecar")
    batch = draw_batch(scene, [0, 4, 8]).truncated(100)
    motions = []
    for substeps, sweeps in ((40, 20), (40, 50), (80, 20)):
        with ENGINE.open(
            scene, Settings(METHOD, 0.02 / substeps, {"solver_iterations": sweeps})
        ) as run:
            motions.append(run.rollout(batch))
        assert motions[-1].failures == (None,) * 3
    start, more_sweeps, finer = motions
    assert np.abs(start.angular_velocity).max() > 80.0
    assert distance(start, more_sweeps).max() < 1e-4
    assert distance(start, finer).max() < 1e-3
    assert gaps(scene, start).min() > -1e-6


def test_the_cubli_flies_as_the_reference_until_the_first_impact() -> None:
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, range(6)).truncated(40)
    exact, motion = reference.solve(scene, batch, cache=False), carefully(scene, batch)
    assert motion.failures == (None,) * 6
    for row, impact in enumerate(exact.failures):
        assert isinstance(impact, reference.FirstImpact)
        flight = slice(0, impact.frame)
        assert distance(motion, exact)[row, flight].max() < 5e-4
        turn = rotation.multiply(
            rotation.conjugate(exact.orientation[row, flight]), motion.orientation[row, flight]
        )
        assert np.linalg.norm(rotation.to_vector(turn), axis=-1).max() < 1e-3
    assert gaps(scene, motion).min() > -2e-3


def test_flight_exchanges_angular_momentum_and_keeps_its_sum() -> None:
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, [2], noise=False).truncated(40)
    mechanism, motion = Mechanism.of(scene), carefully(scene, batch)
    impact = reference.solve(scene, batch, cache=False).failures[0]
    assert isinstance(impact, reference.FirstImpact)
    frames = slice(0, impact.frame)
    turn = rotation.matrix(mechanism.native_rotation(motion.orientation[0]))
    inertia = np.einsum("fbij,bjk,fblk->fbil", turn, mechanism.inertia, turn)
    spin = np.einsum("fbij,fbj->fbi", inertia, motion.angular_velocity[0])
    share = mechanism.mass / mechanism.mass.sum()
    arms = motion.position[0] - np.einsum("b,fbi->fi", share, motion.position[0])[:, None]
    orbit = np.cross(arms, mechanism.mass[:, None] * motion.velocity[0])
    own = (spin + orbit)[frames]
    total = own.sum(axis=1)
    assert np.linalg.norm(own - own[0], axis=-1).max() > 0.2
    assert np.linalg.norm(total - total[0], axis=-1).max() < 2e-4 * np.linalg.norm(total[0])
