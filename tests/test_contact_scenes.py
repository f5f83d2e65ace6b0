"""The four scenes with contact against the page that defines them, with figures derived by hand."""

from __future__ import annotations

import math
import sys
from collections import Counter

import msgspec
import numpy as np
import pytest
from scipy import stats

from mbds_xsim import __main__ as cli
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import HingeRate, Roll
from mbds_xsim.scene.scene import Clock, ContactSphere, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene

CONTACT_SCENES = ("ballscroll", "balldrop", "particlecar", "simplecubli")
OWN = 6.17e-4
"""Inertia of a particle of 1 kg, hence its radius."""
R = math.sqrt(5 * OWN / 2)
WHEELS = {
    "front_left": (0.4, 0.25, 0.2),
    "front_right": (0.4, -0.25, 0.2),
    "rear_left": (-0.4, 0.25, 0.2),
    "rear_right": (-0.4, -0.25, 0.2),
}
MIDDLE = np.array([0.0, 0.0, 0.6])
"""Of the cubli at its reference pose."""
STARTS = 600


def _starts(name: str) -> Batch:
    """Draw many starts; a single step and no noise leave them what they are."""
    scene = msgspec.structs.replace(load_scene(name), clock=Clock(steps=1), noise=0.0)
    return draw_batch(scene, range(STARTS), seed=11)


def _of_interval(values: Array, interval: int) -> Array:
    return values[interval::3].reshape(-1)


def _assert_uniform(values: Array, low: float, high: float) -> None:
    """Bounds, and Kolmogorov and Smirnov's test; the draws are always the same."""
    assert low <= values.min()
    assert values.max() <= high
    assert stats.kstest(values, "uniform", (low, high - low)).pvalue > 0.01


def _inertia(name: str, body: str) -> Array:
    scene = load_scene(name)
    place = [b.name for b in scene.bodies].index(body)
    return np.asarray(Mechanism.of(scene).inertia[place])


def test_the_papers_scenes_have_32_particles_on_average() -> None:
    counts = [load_scene(name).particle_count for name in PAPER_SCENES]

    assert len(counts) == 8
    assert round(float(np.mean(counts)), 1) == 32.4


@pytest.mark.parametrize("name", CONTACT_SCENES)
def test_ground_has_the_papers_friction_and_damping(name: str) -> None:
    ground = load_scene(name).ground
    assert ground is not None

    # ζ is got back from the logarithmic decrement of half a period, Λ = −ln e.
    decrement = -math.log(ground.restitution)

    assert ground.friction == 0.43
    assert round(ground.restitution, 4) == 0.9332
    assert decrement / math.hypot(math.pi, decrement) == pytest.approx(0.022, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "allowed"), [("ballscroll", 2e-3), ("balldrop", 2e-2), ("simplecubli", 5e-4)]
)
def test_budget_of_the_error_in_metres(name: str, allowed: float) -> None:
    scene = load_scene(name)

    assert scene.budget.error * scene.length == pytest.approx(allowed)
    assert scene.budget.error_1s <= scene.budget.error


def test_ball_is_one_solid_particle_on_the_ground() -> None:
    scene = load_scene("ballscroll")
    mechanism = Mechanism.of(scene)

    np.testing.assert_allclose(mechanism.com, [[0.0, 0.0, R]], rtol=1e-15)
    np.testing.assert_allclose(mechanism.inertia, [OWN * np.eye(3)], rtol=1e-15)
    np.testing.assert_array_equal(mechanism.sphere_offset, np.zeros((1, 3)))
    # A solid sphere: I = 2/5 m r².
    assert mechanism.sphere_radius[0] == pytest.approx(math.sqrt(5 * OWN / 2), rel=1e-15)


def test_disc_is_a_hexagon_of_touching_particles() -> None:
    scene = load_scene("balldrop")
    mechanism = Mechanism.of(scene)
    distance = np.linalg.norm(mechanism.particle_offset, axis=1) / R

    # 6 at 2 r; of the 12 outer ones 6 corners at 4 r and 6 between them at 2 √3 r.
    expected = [0.0] + [2.0] * 6 + sorted([4.0] * 6 + [2 * math.sqrt(3)] * 6)
    np.testing.assert_allclose([distance[0], *sorted(distance[1:])], expected, atol=1e-14)
    assert (distance[1:7] < 3.0).all()
    np.testing.assert_array_equal(mechanism.particle_offset[:, 1], 0.0)
    np.testing.assert_allclose(mechanism.com, [[0.0, 0.0, 1.0]], atol=1e-15)
    # With I = 2/5 r²: 19 I + (6·4 + 6·16 + 6·12) r² = 199.6 r² about y, half the second part else.
    flat, normal = 103.6 * R**2, 199.6 * R**2
    np.testing.assert_allclose(mechanism.inertia[0], np.diag([flat, normal, flat]), atol=1e-15)
    np.testing.assert_allclose(mechanism.sphere_offset, np.zeros((1, 3)), atol=1e-15)
    assert mechanism.sphere_radius[0] == pytest.approx(5 * R)
    assert distance.max() + 1 == pytest.approx(5.0)


def test_chassis_is_a_lattice_of_twenty() -> None:
    mechanism = Mechanism.of(load_scene("particlecar"))
    # Σx² = 8 (0.4² + 0.2²), Σy² = 20 · 0.15², Σz² = 20 · 0.05² about the middle.
    x2, y2, z2, own = 1.6, 0.45, 0.05, 20 * OWN

    assert mechanism.mass[0] == 20.0
    np.testing.assert_allclose(mechanism.com[0], [0.0, 0.0, 0.25], atol=1e-16)
    np.testing.assert_allclose(
        _inertia("particlecar", "chassis"),
        np.diag([y2 + z2 + own, x2 + z2 + own, x2 + y2 + own]),
        atol=1e-14,
    )


@pytest.mark.parametrize("wheel", WHEELS)
def test_wheels_of_the_car(wheel: str) -> None:
    scene = load_scene("particlecar")
    mechanism = Mechanism.of(scene)
    place = [body.name for body in scene.bodies].index(wheel)
    offset = mechanism.particle_offset[mechanism.particle_body == place]
    ring = 0.2 - R

    assert mechanism.mass[place] == 13.0
    np.testing.assert_allclose(mechanism.com[place], WHEELS[wheel], atol=1e-15)
    # 12 at the ring's radius: all of it counts about the axle, half of it across.
    across = 6 * ring**2 + 13 * OWN
    expected = np.diag([across, 12 * ring**2 + 13 * OWN, across])
    np.testing.assert_allclose(mechanism.inertia[place], expected, atol=1e-15)
    np.testing.assert_allclose(offset[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(offset[1], [ring, 0.0, 0.0], atol=1e-15)
    # Each is the one before turned by 30° about the axle.
    turn = rotation.from_vector(np.array([0.0, math.pi / 6, 0.0]))
    following = np.roll(offset[1:], -1, axis=0)
    np.testing.assert_allclose(rotation.rotate(turn, offset[1:]), following, atol=1e-15)


def test_axles_and_contact_spheres_of_the_car() -> None:
    scene = load_scene("particlecar")
    mechanism = Mechanism.of(scene)

    for joint in mechanism.joints:
        assert scene.bodies[joint.parent].name == "chassis"
        assert scene.bodies[joint.child].name == joint.name
        np.testing.assert_allclose(joint.anchor, WHEELS[joint.name], atol=1e-15)
        np.testing.assert_array_equal(joint.axis, [0.0, 1.0, 0.0])
    assert {s.body: (s.center, s.radius) for s in scene.contacts} == {
        name: (hub, 0.2) for name, hub in WHEELS.items()
    }


def test_frame_is_the_edges_of_a_cube() -> None:
    mechanism = Mechanism.of(load_scene("simplecubli"))
    particles = mechanism.particle_offset[mechanism.particle_body == 0]

    # Corners and edges along y or z lie at ±0.2 in x; the 8 of the edges along x at ±0.2 / 3.
    x2 = (8 + 16) * 0.04 + 8 * 0.04 / 9
    assert mechanism.mass[0] == 32.0
    np.testing.assert_allclose(mechanism.com[0], MIDDLE, atol=1e-15)
    np.testing.assert_allclose(
        _inertia("simplecubli", "frame"), (2 * x2 + 32 * OWN) * np.eye(3), atol=1e-14
    )
    at_end = np.isclose(np.abs(particles), 0.2)
    assert Counter(at_end.sum(axis=1).tolist()) == {3: 8, 2: 24}
    np.testing.assert_allclose(np.abs(particles[~at_end]), 0.2 / 3)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_flywheels_of_the_cubli(k: int) -> None:
    scene = load_scene("simplecubli")
    mechanism = Mechanism.of(scene)
    axis, first = np.eye(3)[k], np.eye(3)[(k + 1) % 3]
    name = f"flywheel_{'xyz'[k]}"
    place = [body.name for body in scene.bodies].index(name)
    offset = mechanism.particle_offset[mechanism.particle_body == place]
    (joint,) = [joint for joint in mechanism.joints if joint.name == name]

    assert (joint.parent, joint.child) == (0, place)
    np.testing.assert_array_equal(joint.axis, axis)
    np.testing.assert_allclose(joint.anchor, MIDDLE + 0.12 * axis, atol=1e-15)
    np.testing.assert_allclose(mechanism.com[place], MIDDLE + 0.12 * axis, atol=1e-15)
    # 12 · 0.06² about the axis, half of it across, and 13 particles' own.
    expected = 0.0216 * (np.eye(3) + np.outer(axis, axis)) + 13 * OWN * np.eye(3)
    np.testing.assert_allclose(mechanism.inertia[place], expected, atol=1e-15)
    np.testing.assert_allclose(offset[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(offset[1], 0.06 * first, atol=1e-15)
    np.testing.assert_allclose(offset[1:] @ axis, 0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(offset[1:], axis=1), 0.06)


def test_contact_spheres_of_the_cubli_are_its_corner_particles() -> None:
    scene = load_scene("simplecubli")
    signs = {tuple(np.sign(np.subtract(s.center, MIDDLE)).tolist()) for s in scene.contacts}

    assert {s.body for s in scene.contacts} == {"frame"}
    assert len(signs) == 8
    for sphere in scene.contacts:
        np.testing.assert_allclose(np.abs(np.subtract(sphere.center, MIDDLE)), 0.2)
        assert sphere.radius == pytest.approx(R, rel=1e-15)


def _edge_lengths(scene: Scene) -> list[float]:
    mechanism = Mechanism.of(scene)
    points = mechanism.com[mechanism.particle_body] + mechanism.particle_offset
    first, second = np.array(scene.edges).T
    return sorted(np.linalg.norm(points[first] - points[second], axis=1).tolist())


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # A hexagon of side 3 has 42 sides between its 19 nodes.
        ("balldrop", {2 * R: 42}),
        # Lattice of 5·2·2: 4·4 along x, 5·2 along y, 5·2 along z; wheels; each hub to one corner.
        (
            "particlecar",
            {
                0.2: 16,
                0.3: 10,
                0.1: 10 + 4,
                0.2 - R: 48,
                2 * (0.2 - R) * math.sin(math.pi / 12): 48,
            },
        ),
        # 12 edges of 3 pieces; flywheels; each hub to the 8 that are 2/3 up the face's edges.
        (
            "simplecubli",
            {
                0.4 / 3: 36,
                0.06: 36,
                0.12 * math.sin(math.pi / 12): 36,
                math.hypot(0.08, 0.2, 0.2 / 3): 24,
            },
        ),
    ],
)
def test_edges(name: str, expected: dict[float, int]) -> None:
    scene = load_scene(name)

    lengths = sorted(length for length, count in expected.items() for _ in range(count))
    np.testing.assert_allclose(_edge_lengths(scene), lengths, rtol=1e-12)
    assert len(set(map(frozenset, scene.edges))) == len(scene.edges)


@pytest.mark.parametrize("name", ["balldrop", "particlecar", "simplecubli"])
def test_edges_hang_together(name: str) -> None:
    scene = load_scene(name)
    reached, grown = {0}, True
    while grown:
        more = {n for edge in scene.edges if reached & set(edge) for n in edge}
        grown = not more <= reached
        reached |= more

    assert reached == set(range(scene.particle_count))


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
    """Height of each contact sphere's lowest point [m], shape (trajectory, sphere)."""
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


def _call(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["mbds-xsim", *words])
    # Left alone, the entry point would change what a signal does to the test run.
    monkeypatch.setattr("signal.signal", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return (int(ended.value.code or 0), *capsys.readouterr())


def test_the_list_of_scenes_has_all_eight(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = _call(["scenes", "--json", "-"], monkeypatch, capsys)
    rows = msgspec.json.decode(out)

    assert code == 0
    listed = {
        row["scene"]: (row["dimension"], row["bodies"], row["particles"], row["degrees_of_freedom"])
        for row in rows
    }
    assert list(listed.items())[:8] == [
        ("ballscroll", (1, 1, 1, 6)),
        ("balldrop", (2, 1, 19, 6)),
        ("5pendulum", (3, 5, 5, 15)),
        ("6pendulum", (3, 6, 6, 18)),
        ("2ladder", (3, 26, 34, 72)),
        ("3ladder", (3, 39, 51, 108)),
        ("particlecar", (3, 5, 72, 10)),
        ("simplecubli", (3, 4, 71, 9)),
    ]
    free = ["free body", "force at the centre of mass", "sphere on the ground"]
    needs = {row["scene"]: row["needs"] for row in rows}
    assert needs["ballscroll"] == needs["balldrop"] == free
    assert needs["particlecar"] == needs["simplecubli"]
    assert needs["simplecubli"] == [
        *("hinge joint", *free[:2], "hinge torque", free[2]),
        "spheres of joined bodies, or off centre",
    ]


def test_a_scene_can_be_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = _call(["show", "simplecubli"], monkeypatch, capsys)

    assert code == 0
    assert "4 bodies, 71 particles, 71 kg, 9 degrees of freedom, 3D" in out
    assert out.splitlines()[-3:] == [
        "draws throw (body: frame; displacement: z [0, 0.9]; orientation: uniform; "
        "velocity: x [-1, 1], y [-1, 1], z [-1, 1]; "
        "angular_velocity: x [-2, 2], y [-2, 2], z [-2, 2])",
        "draws hinge_rate (joints: flywheel_x, flywheel_y, flywheel_z; rate: [-10, 10])",
        "draws hinge_torque (joints: flywheel_x, flywheel_y, flywheel_z; "
        "torque: low [0, 0.5], medium [0.5, 1.5], high [1.5, 3]; hold: 10; random_sign: True)",
    ]


def test_only_what_moves_is_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, disc, _ = _call(["show", "balldrop"], monkeypatch, capsys)
    _, car, _ = _call(["show", "particlecar"], monkeypatch, capsys)

    assert "velocity: x low [-1, 1], medium [-3, 3], high [-6, 6]; angular_velocity: y " in disc
    assert "high [70, 100]; travel: [0.2, 0, 0])" in car


def test_methods_that_cannot_do_contact_refuse_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("exudyn")
    words = ["validate", "ballscroll", "--engines", "exudyn", "--method", "RK44"]
    code, out, error = _call(words, monkeypatch, capsys)

    assert code == 2
    assert not out
    assert "exudyn RK44 cannot do sphere on the ground: friction" in error
    assert "use --method trapezoidal" in error
