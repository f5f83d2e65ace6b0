"""PyBullet on the ground, against exact answers and the reference."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Ground, Inertia, Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing.contact_cases import RADIUS as R
from mbds_xsim.testing.contact_cases import ball, crate, gaps
from tests.adapters.exact import Runs, balldrop_followed, ballscroll_followed
from tests.over_ground import over_ground

pytest.importorskip("pybullet")

ENGINE = load_adapter("pybullet")
METHOD = "semi-implicit-euler"
Vector = tuple[float, float, float]
MU, E, G = 0.43, 0.9332, 9.81
STILL = (0.0, 0.0, 0.0)


def careful(steps_per_frame: int, **options: float) -> Settings:
    return Settings(METHOD, 0.02 / steps_per_frame, options)


CAREFUL = {
    "ballscroll": careful(40),
    "balldrop": careful(200),
    "simplecubli": careful(320, solver_iterations=50),
}
"""Settings finer than the matched ones, for tests of the contact laws."""


_RUNS = Runs(ENGINE, CAREFUL)
simulate = Runs(ENGINE, {}).stepped


def distance(one: Trajectory, other: Trajectory) -> Array:
    """Distance between the first bodies [m], shape (trajectory, frame)."""
    return np.asarray(np.linalg.norm(one.position - other.position, axis=-1)[..., 0])


@pytest.mark.parametrize("noise", [False, True])
def test_ballscroll_follows_the_exact_solution(noise: bool) -> None:
    ballscroll_followed(_RUNS.rollout, noise=noise)


@pytest.mark.parametrize("noise", [False, True])
def test_balldrop_follows_the_exact_solution(noise: bool) -> None:
    motion = balldrop_followed(_RUNS.rollout, 6, noise=noise, apex=3e-3, flight=5e-4)

    assert motion.position[..., 2].min() > 5 * R - 1e-3


@pytest.mark.parametrize("speed", [1e-3, 0.02, 0.1, 1.0, 10.0])
def test_restitution_does_not_depend_on_the_speed_of_impact(speed: float) -> None:
    scene = ball(height=1e-3 * speed, velocity=(0.0, 0.0, -speed), steps=1)
    weightless = msgspec.structs.replace(scene, gravity=STILL)
    # Pushing the overlap out adds a share of the speed: a step over a second.
    climb = simulate(weightless, 200).velocity[0, -1, 0, 2]
    assert climb == pytest.approx(E * speed, rel=2e-4, abs=1.1e-6 / 1e-4 * (speed < 0.02))


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
    return over_ground(body, centre, R, Ground(MU, E), gravity=STILL, clock=Clock(steps=1))


def _impulse(arm: Array, velocity: Array) -> Array:
    """Impulse of Newton's restitution with Coulomb's friction on `_corner`, x and z [N·s]."""
    turn = np.array([arm[1], -arm[0]])  # velocity of the point at unit spin about y
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
    """If contacts began at zero gap, rounding would drop touching wheels: 0.4 m of error."""
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


def test_a_step_that_ends_just_above_the_ground_costs_no_rebound() -> None:
    """The fall of 5000 steps ends 0.5 µm above the ground."""
    still = ball(1.0, ground=Ground(0.0, E), steps=6)
    step, count = ENGINE.settings(still, "matched").step, 5000
    scene = ball(G * step**2 * count * (count + 1) / 2 + 5e-7, ground=Ground(0.0, E), steps=6)
    batch = draw_batch(scene, [0])
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(batch)
    exact = reference.solve(scene, batch, cache=False)
    assert motion.velocity[0, -1, 0, 2] == pytest.approx(exact.velocity[0, -1, 0, 2], abs=2e-3)
