"""Starts and inputs of the four scenes with contact, as the page that defines them has them."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy import stats

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import HingeRate, Roll
from mbds_xsim.scene.scene import Clock, ContactSphere, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.registry import load_scene

CONTACT_SCENES = ("ballscroll", "balldrop", "particlecar", "simplecubli")
R = math.sqrt(5 * 6.17e-4 / 2)
"""Radius of a particle of 1 kg, from its inertia."""
STARTS = 600


def _starts(name: str) -> Batch:
    """Draw many starts; a single step and no noise leave them what they are."""
    scene = msgspec.structs.replace(load_scene(name), clock=Clock(steps=1), noise=0.0)
    return draw_batch(scene, range(STARTS), seed=11)


def _of_interval(values: Array, interval: int) -> Array:
    return values[interval::3].reshape(-1)


def _assert_uniform(values: Array, low: float, high: float) -> None:
    """Check bounds and the Kolmogorov-Smirnov test; the draws are always the same."""
    assert low <= values.min()
    assert values.max() <= high
    assert stats.kstest(values, "uniform", (low, high - low)).pvalue > 0.01


def _drawn(low: float, high: float, rng: np.random.Generator, count: int) -> Array:
    return np.array([rng.uniform(low, high) for _ in range(count)])


@pytest.mark.parametrize("index", [0, 4, 8])
def test_a_ball_is_drawn_in_the_documented_order(index: int) -> None:
    batch = draw_batch(load_scene("ballscroll"), [index], seed=5)
    rng = np.random.default_rng(np.random.SeedSequence([5, index]))
    low, high = ((1.0, 3.0), (3.0, 7.0), (7.0, 10.0))[index % 3]

    _drawn(0.0, 0.0, rng, 3)
    velocity = rng.uniform(low, high)
    _drawn(0.0, 0.0, rng, 5)
    spin = rng.uniform(0.0, 1.0) * velocity / R
    noise = 0.1 * rng.standard_normal((200, 1, 1))

    np.testing.assert_array_equal(batch.velocity[0, 0], [velocity, 0.0, 0.0])
    np.testing.assert_allclose(batch.angular_velocity[0, 0], [0.0, spin, 0.0], rtol=1e-15)
    np.testing.assert_allclose(batch.force[0], noise * [1.0, 0.0, 0.0], rtol=1e-14)


@pytest.mark.parametrize("index", [0, 4, 8])
def test_a_car_is_drawn_in_the_documented_order(index: int) -> None:
    batch = draw_batch(load_scene("particlecar"), [index], seed=5)
    rng = np.random.default_rng(np.random.SeedSequence([5, index]))
    low, high = ((10.0, 30.0), (30.0, 70.0), (70.0, 100.0))[index % 3]

    rates = _drawn(low, high, rng, 4)
    torques = [_drawn(-2.0, 2.0, rng, 4) for _ in range(20)]
    noise = rng.standard_normal((200, 5, 3)) * 0.1 * np.sqrt([[20], [13], [13], [13], [13]])

    np.testing.assert_allclose(batch.velocity[0], [[0.2 * rates.mean(), 0.0, 0.0]] * 5, atol=1e-13)
    np.testing.assert_allclose(batch.angular_velocity[0, 1:, 1], rates, rtol=1e-15)
    np.testing.assert_array_equal(batch.torque[0], np.repeat(torques, 10, axis=0))
    np.testing.assert_allclose(batch.force[0], noise, rtol=1e-14)


@pytest.mark.parametrize("name", CONTACT_SCENES)
def test_a_trajectory_depends_on_seed_and_index_alone(name: str) -> None:
    scene = load_scene(name)

    among_others, alone = draw_batch(scene, [3, 7], seed=2), draw_batch(scene, [7], seed=2)
    other = draw_batch(scene, [7], seed=3)

    keys = ("position", "orientation", "velocity", "angular_velocity", "force", "torque")
    for key in keys:
        np.testing.assert_array_equal(getattr(among_others, key)[1], getattr(alone, key)[0])
    assert any(not np.array_equal(getattr(alone, key), getattr(other, key)) for key in keys)


@pytest.mark.parametrize("name", CONTACT_SCENES)
def test_starts_stay_without_noise_and_inputs(name: str) -> None:
    scene = load_scene(name)

    full, quiet = draw_batch(scene, range(3)), draw_batch(scene, range(3), noise=False)
    still = draw_batch(scene, range(3), noise=False, inputs=False)

    for key in ("position", "orientation", "velocity", "angular_velocity"):
        np.testing.assert_array_equal(getattr(full, key), getattr(still, key))
    np.testing.assert_array_equal(full.torque, quiet.torque)
    assert not quiet.force.any()
    assert not still.torque.any()


@pytest.mark.parametrize(
    ("name", "components"),
    [
        ("ballscroll", [0]),
        ("balldrop", [0, 2]),
        ("particlecar", [0, 1, 2]),
        ("simplecubli", [0, 1, 2]),
    ],
)
def test_noise_acts_in_the_scenes_dimensions(name: str, components: list[int]) -> None:
    scene = load_scene(name)
    force = draw_batch(scene, range(30)).force

    others = sorted({0, 1, 2} - set(components))
    assert not force[..., others].any()
    # 6000 normal numbers a component: their deviation is known to 1 %.
    expected = 0.1 * np.sqrt(Mechanism.of(scene).particles_per_body)
    for component in components:
        np.testing.assert_allclose(force[..., component].std(axis=(0, 1)), expected, rtol=0.04)


@pytest.mark.parametrize("name", ["ballscroll", "balldrop"])
def test_starts_lie_in_the_scenes_dimensions(name: str) -> None:
    batch = _starts(name)

    assert not batch.position[..., 1].any()
    assert not batch.velocity[..., 1:].any()
    assert not batch.angular_velocity[..., [0, 2]].any()
    np.testing.assert_allclose(batch.orientation[..., [1, 3]], 0.0, atol=1e-15)


def _sphere_bottoms(scene: Scene, batch: Batch) -> Array:
    """Return the height of each contact sphere's lowest point [m], shape (trajectory, sphere)."""
    mechanism = Mechanism.of(scene)
    turn = mechanism.native_rotation(batch.orientation)[:, mechanism.sphere_body]
    arms = rotation.rotate(turn, mechanism.sphere_offset)
    centres = batch.position[:, mechanism.sphere_body] + arms
    return np.asarray(centres[..., 2] - mechanism.sphere_radius)


@pytest.mark.parametrize("name", ["ballscroll", "particlecar"])
def test_starts_on_the_ground(name: str) -> None:
    np.testing.assert_allclose(_sphere_bottoms(load_scene(name), _starts(name)), 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "lowest"),
    [("balldrop", 1.0 - 5 * R), ("simplecubli", 0.6 - 0.2 * math.sqrt(3) - R)],
)
def test_starts_in_the_air(name: str, lowest: float) -> None:
    bottoms = _sphere_bottoms(load_scene(name), _starts(name))

    assert bottoms.min() > lowest > 0.0


@pytest.mark.parametrize(
    ("interval", "low", "high"), [(0, 1.0, 3.0), (1, 3.0, 7.0), (2, 7.0, 10.0)]
)
def test_speed_and_spin_of_the_ball(interval: int, low: float, high: float) -> None:
    batch = _starts("ballscroll")
    speed = batch.velocity[:, 0, 0]

    _assert_uniform(_of_interval(speed, interval), low, high)
    _assert_uniform(_of_interval(batch.angular_velocity[:, 0, 1] * R / speed, interval), 0.0, 1.0)


def test_height_turn_and_spin_of_the_disc() -> None:
    batch = _starts("balldrop")
    angle = 2.0 * np.arctan2(batch.orientation[:, 0, 2], batch.orientation[:, 0, 0])

    _assert_uniform(batch.position[:, 0, 2], 1.0, 3.0)
    _assert_uniform(angle % (2 * math.pi), 0.0, 2 * math.pi)
    _assert_uniform(batch.angular_velocity[:, 0, 1], -10.0, 10.0)


@pytest.mark.parametrize(("interval", "most"), [(0, 1.0), (1, 3.0), (2, 6.0)])
def test_velocity_of_the_disc(interval: int, most: float) -> None:
    _assert_uniform(_of_interval(_starts("balldrop").velocity[:, 0, 0], interval), -most, most)


@pytest.mark.parametrize(
    ("interval", "low", "high"), [(0, 10.0, 30.0), (1, 30.0, 70.0), (2, 70.0, 100.0)]
)
def test_wheel_speeds_of_the_car(interval: int, low: float, high: float) -> None:
    batch = _starts("particlecar")
    rates = batch.angular_velocity[:, 1:, 1]

    _assert_uniform(_of_interval(rates, interval), low, high)
    assert (np.ptp(rates, axis=1) > 0).all()
    assert not batch.angular_velocity[:, 0].any()
    assert not batch.angular_velocity[..., [0, 2]].any()


def test_the_car_starts_upright_and_without_slip_in_the_mean() -> None:
    scene = load_scene("particlecar")
    batch = _starts("particlecar")
    down = np.array([0.0, 0.0, -0.2])
    slip = batch.velocity[:, 1:] + np.cross(batch.angular_velocity[:, 1:], down)

    np.testing.assert_allclose(batch.position, [Mechanism.of(scene).com] * STARTS, atol=1e-15)
    np.testing.assert_array_equal(batch.orientation, [[[1.0, 0.0, 0.0, 0.0]] * 5] * STARTS)
    np.testing.assert_allclose(slip.mean(axis=1), 0.0, atol=1e-13)
    assert (np.abs(slip[..., 0]) > 0).all()
    assert (batch.velocity[..., 0] > 0).all()


def test_throw_of_the_cubli() -> None:
    batch = _starts("simplecubli")

    np.testing.assert_allclose(batch.position[:, 0, :2], 0.0, atol=1e-15)
    _assert_uniform(batch.position[:, 0, 2], 0.6, 1.5)
    for component in range(3):
        _assert_uniform(batch.velocity[:, 0, component], -1.0, 1.0)
        _assert_uniform(batch.angular_velocity[:, 0, component], -2.0, 2.0)


def test_orientation_of_the_cubli_is_uniform_on_rotations() -> None:
    turn = rotation.matrix(_starts("simplecubli").orientation[:, 0])

    # By Archimedes every component of a uniform direction is uniform.
    for row in range(3):
        for column in range(3):
            _assert_uniform(turn[:, row, column], -1.0, 1.0)
    # The angle of a uniform rotation has the density (1 − cos θ) / π.
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    assert stats.kstest(angle, lambda a: (a - np.sin(a)) / math.pi).pvalue > 0.01


def test_flywheels_go_along_with_the_frame_and_turn_about_their_axes() -> None:
    batch = _starts("simplecubli")
    turn, frame_rate = batch.orientation[:, :1], batch.angular_velocity[:, :1]
    arms = rotation.rotate(turn, 0.12 * np.eye(3))
    axes = rotation.rotate(turn, np.eye(3))
    relative = batch.angular_velocity[:, 1:] - frame_rate
    rates = np.sum(relative * axes, axis=-1)

    np.testing.assert_allclose(batch.position[:, 1:], batch.position[:, :1] + arms, atol=1e-14)
    np.testing.assert_allclose(
        batch.velocity[:, 1:], batch.velocity[:, :1] + np.cross(frame_rate, arms), atol=1e-14
    )
    np.testing.assert_array_equal(batch.orientation[:, 1:], np.repeat(turn, 3, axis=1))
    np.testing.assert_allclose(relative, rates[..., None] * axes, atol=1e-14)
    for flywheel in range(3):
        _assert_uniform(rates[:, flywheel], -10.0, 10.0)


def test_torques_of_the_car() -> None:
    torque = draw_batch(load_scene("particlecar"), range(12)).torque.reshape(12, 20, 10, 4)

    assert (torque == torque[:, :, :1]).all()
    _assert_uniform(torque[:, :, 0].reshape(-1), -2.0, 2.0)


@pytest.mark.parametrize(("interval", "low", "high"), [(0, 0.0, 0.5), (1, 0.5, 1.5), (2, 1.5, 3.0)])
def test_torques_of_the_cubli(interval: int, low: float, high: float) -> None:
    torque = draw_batch(load_scene("simplecubli"), range(interval, 36, 3)).torque
    stretches = torque.reshape(12, 20, 10, 3)
    values = stretches[:, :, 0].reshape(-1)

    assert (stretches == stretches[:, :, :1]).all()
    _assert_uniform(np.abs(values), low, high)
    assert stats.binomtest(int((values > 0).sum()), len(values)).pvalue > 0.01


def test_what_carries_no_single_centred_sphere_cannot_roll() -> None:
    ball = load_scene("ballscroll")
    raised = ContactSphere("ball", (0.0, 0.0, R + 1e-3), R)

    for contacts in ((raised,), (ball.contacts[0], raised)):
        scene = msgspec.structs.replace(ball, contacts=contacts)
        with pytest.raises(SceneError, match="one, centred at its centre of mass"):
            draw_batch(scene, [0])


def test_roll_of_an_unknown_body_is_refused() -> None:
    with pytest.raises(SceneError, match=r"sampling\[0\].body: no body is called 'bowl'"):
        msgspec.structs.replace(
            load_scene("ballscroll"), sampling=(Roll("bowl", share=(0.0, 1.0)),)
        )


def test_what_the_world_holds_cannot_travel() -> None:
    car = load_scene("particlecar")
    pinned = msgspec.structs.replace(car.joints[0], name="post", kind="hinge", parent="world")
    pinned = msgspec.structs.replace(pinned, child="chassis")
    scene = msgspec.structs.replace(car, joints=(pinned, *car.joints))

    with pytest.raises(SceneError, match="held by the world, not free"):
        draw_batch(scene, [0])


def test_travel_moves_only_what_is_jointed_to_the_hinges() -> None:
    car = load_scene("particlecar")
    ball = load_scene("ballscroll").bodies[0]
    rate = HingeRate(("front_left", "rear_right"), rate=(10.0, 20.0), travel=(0.0, 0.3, 0.0))
    scene = msgspec.structs.replace(car, bodies=(*car.bodies, ball), sampling=(rate,))

    batch = draw_batch(scene, [0], noise=False)

    rates = batch.angular_velocity[0, [1, 4], 1]
    np.testing.assert_allclose(batch.velocity[0, :5, 1], 0.3 * rates.mean(), rtol=1e-14)
    assert not batch.velocity[0, 5].any()
    assert not batch.angular_velocity[0, [0, 2, 3, 5]].any()
