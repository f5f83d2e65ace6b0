"""The four scenes with contact against the page that defines them, with figures derived by hand."""

from __future__ import annotations

import math
import sys
from collections import Counter

import msgspec
import numpy as np
import pytest

from mbds_xsim import __main__ as cli
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene

CONTACT_SCENES = ("ballscroll", "balldrop", "particlecar", "simplecubli")
OWN = 6.17e-4
"""Inertia of a particle of 1 kg [kg m²], from which its radius follows."""
R = math.sqrt(5 * OWN / 2)
WHEELS = {
    "front_left": (0.4, 0.25, 0.2),
    "front_right": (0.4, -0.25, 0.2),
    "rear_left": (-0.4, 0.25, 0.2),
    "rear_right": (-0.4, -0.25, 0.2),
}
MIDDLE = np.array([0.0, 0.0, 0.6])
"""Centre of the cubli at its reference pose [m]."""


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
