"""Exact cases of the car, against laws that they must obey."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.straight_car import straight_run

G, MU, RADIUS = 9.81, 0.43, 0.2


@pytest.fixture(scope="module")
def car() -> Scene:
    return load_scene("particlecar")


def wheel_inertia(scene: Scene) -> float:
    mechanism = Mechanism.of(scene)
    return float(mechanism.inertia[mechanism.hinges[0].child, 1, 1])


def rates(scene: Scene, run: Trajectory) -> Array:
    """Return the rates of a front and a rear wheel [rad/s], shape (frame, 2)."""
    by_name = {body.name: k for k, body in enumerate(scene.bodies)}
    return run.angular_velocity[0][:, [by_name["front_left"], by_name["rear_right"]], 1]


def slips(scene: Scene, run: Trajectory) -> Array:
    return np.asarray(run.velocity[0, :, :1, 0] - RADIUS * rates(scene, run))


@pytest.mark.parametrize(("speed", "spin"), [(0.0, 60.0), (8.0, 0.0), (3.0, 40.0)])
def test_slides_at_the_friction_and_ends_rolling(car: Scene, speed: float, spin: float) -> None:
    """All wheels slip: μ g, whatever their loads; then M v + Σ I ω/R has kept its value."""
    _, run = straight_run(car, speed=speed, rates=(spin, spin))
    ahead = np.sign(RADIUS * spin - speed)
    velocity, time = run.velocity[0, :, 0, 0], run.time
    slipping = (np.abs(slips(car, run)) > 1e-9).all(axis=1)
    assert 3 < slipping.sum() < 150
    expected = speed + ahead * MU * G * time
    np.testing.assert_allclose(velocity[slipping], expected[slipping], rtol=0, atol=1e-12)
    mass, share = Mechanism.of(car).mass.sum(), 4.0 * wheel_inertia(car) / RADIUS**2
    final = (mass * speed + share * RADIUS * spin) / (mass + share)
    assert velocity[-1] == pytest.approx(final, abs=1e-12)
    assert np.abs(slips(car, run)[-1]).max() < 1e-12


def test_loads_decide_which_axle_grips_first(car: Scene) -> None:
    """Braking loads the front wheels, which friction then spins up faster."""
    _, run = straight_run(car, speed=8.0, rates=(0.0, 0.0))
    mechanism = Mechanism.of(car)
    height = mechanism.mass @ mechanism.com[:, 2] / mechanism.mass.sum()
    moved = (height - RADIUS) * MU / 0.8
    loads = mechanism.mass.sum() * G * (0.25 + np.array([0.5, -0.5]) * moved)
    expected = MU * loads * RADIUS / wheel_inertia(car) * run.time[3]
    np.testing.assert_allclose(rates(car, run)[3], expected, rtol=1e-12)
    gripping = (np.abs(slips(car, run)) < 1e-9).argmax(axis=0)
    assert 0 < gripping[0] < gripping[1]


def test_rolls_under_equal_torques(car: Scene) -> None:
    """Grip all the way: a = Σ τ/R / (M + Σ I/R²)."""
    torque = np.full((car.clock.steps, 2), 1.5)
    _, run = straight_run(car, speed=2.0, rates=(10.0, 10.0), torque=torque)
    effective = Mechanism.of(car).mass.sum() + 4.0 * wheel_inertia(car) / RADIUS**2
    expected = 2.0 * run.time + 0.5 * (4.0 * 1.5 / RADIUS / effective) * run.time**2
    np.testing.assert_allclose(run.position[0, :, 0, 0], expected, rtol=0, atol=1e-11)
    assert np.abs(slips(car, run)).max() < 1e-12


def test_strong_torques_spin_the_wheels(car: Scene) -> None:
    """Past the limit of the grip the car gets μ g, and no more."""
    torque = np.full((car.clock.steps, 2), 50.0)
    _, run = straight_run(car, speed=0.0, rates=(0.0, 0.0), torque=torque)
    np.testing.assert_allclose(run.velocity[0, :, 0, 0], MU * G * run.time, rtol=0, atol=1e-11)
    assert slips(car, run)[-1].max() < -1.0


def test_unequal_axles_keep_energy_in_bounds(car: Scene) -> None:
    """Fast in front, slow behind, with torques that change: energy gains at most the work."""
    rng = np.random.default_rng(5)
    torque = np.repeat(rng.uniform(-2.0, 2.0, (20, 2)), 10, axis=0)
    batch, run = straight_run(car, speed=5.0, rates=(40.0, 15.0), torque=torque)
    mechanism, spin = Mechanism.of(car), rates(car, run)
    energy = 0.5 * mechanism.mass.sum() * run.velocity[0, :, 0, 0] ** 2
    energy += wheel_inertia(car) * np.sum(spin**2, axis=1)
    angle = 0.02 * 0.5 * (spin[1:] + spin[:-1])
    constant = np.abs(np.diff(spin, 2, axis=0)).max(axis=1) < 1e-9
    gain = np.diff(energy) - 2.0 * np.sum(torque * angle, axis=1)
    assert gain[1:][constant].max() < 1e-9
    assert batch.torque.shape == (1, car.clock.steps, 4)
    np.testing.assert_array_equal(batch.torque[0, :, [0, 1]], torque[:, 0] * np.ones((2, 1)))
    assert np.abs(slips(car, run)[0]).min() > 1.0
    assert np.abs(slips(car, run)[-1]).max() < 1e-10


def test_start_is_the_batch(car: Scene) -> None:
    batch, run = straight_run(car, speed=5.0, rates=(40.0, 15.0))
    for field in dataclasses.fields(batch)[1:5]:
        np.testing.assert_allclose(
            getattr(run, field.name)[:, 0], getattr(batch, field.name), rtol=0, atol=1e-15
        )


def test_refuses_what_is_no_car(car: Scene) -> None:
    with pytest.raises(SceneError, match="0 hinges"):
        straight_run(load_scene("balldrop"), speed=1.0, rates=(0.0, 0.0))
    torque = np.full((car.clock.steps, 2), 4000.0)
    with pytest.raises(SceneError, match="lifts off"):
        straight_run(car, speed=0.0, rates=(0.0, 0.0), torque=torque)
