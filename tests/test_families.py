"""The built-in families against the page that defines them, with figures derived by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mbds_xsim.base.errors import UnknownName
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.constraints import constraint_rows, degrees_of_freedom
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import load_scene

OWN = 6.17e-4
RUNG = 5 * OWN + 2 * (0.2**2 + 0.1**2)
"""Inertia of a rung about an axis across it: five particles, 0, ±0.1 and ±0.2 m off its middle."""


@pytest.mark.parametrize(
    ("name", "size", "length"),
    [
        # Dimension, bodies, particles, joints, loops, contact spheres, degrees of freedom.
        ("5pendulum", (3, 5, 5, 5, 0, 0, 15), 2.5),
        ("6pendulum", (3, 6, 6, 6, 0, 0, 18), 3.0),
        ("32pendulum", (3, 32, 32, 32, 0, 0, 96), 16.0),
        ("2ladder", (3, 26, 34, 28, 2, 0, 72), 1.2),
        ("3ladder", (3, 39, 51, 42, 3, 0, 108), 1.8),
        ("5ladder", (3, 65, 85, 70, 5, 0, 180), 3.0),
        ("ballscroll", (1, 1, 1, 0, 0, 1, 6), 1.0),
        ("balldrop", (2, 1, 19, 0, 0, 1, 6), 1.0),
        ("particlecar", (3, 5, 72, 4, 0, 4, 10), 0.8),
        ("simplecubli", (3, 4, 71, 3, 0, 8, 9), 0.4),
    ],
)
def test_size_of_each_scene(name: str, size: tuple[int, ...], length: float) -> None:
    scene = load_scene(name)
    mechanism = Mechanism.of(scene)
    counts = (len(scene.joints), len(mechanism.loops), len(scene.contacts))
    bodies = (scene.dimension, mechanism.body_count, scene.particle_count)

    assert scene.name == name
    assert (*bodies, *counts, degrees_of_freedom(mechanism)) == size
    assert {joint.kind for joint in scene.joints} <= {"hinge" if scene.contacts else "ball"}
    assert mechanism.mass.sum() == pytest.approx(scene.particle_count)
    assert scene.length == pytest.approx(length)
    assert (scene.clock.frame, scene.clock.steps) == (0.02, 200)
    assert scene.gravity == (0.0, 0.0, -9.81)
    assert scene.noise == 0.1


def test_links_of_the_pendulum() -> None:
    mechanism = Mechanism.of(load_scene("6pendulum"))

    np.testing.assert_array_equal(mechanism.mass, np.ones(6))
    np.testing.assert_allclose(mechanism.inertia, np.tile(OWN * np.eye(3), (6, 1, 1)), atol=1e-18)
    np.testing.assert_allclose(mechanism.com, [[0, 0, -0.5 * k] for k in range(1, 7)])
    for link in mechanism.links:
        assert link.joint is not None
        np.testing.assert_allclose(link.joint.in_child, [0.0, 0.0, 0.5], atol=1e-15)
        np.testing.assert_allclose(link.joint.in_parent, np.zeros(3), atol=1e-15)
    np.testing.assert_allclose(mechanism.particle_offset, np.zeros((6, 3)))


@pytest.mark.parametrize("rungs", [2, 3])
def test_rods_and_rungs_of_the_ladder(rungs: int) -> None:
    scene = load_scene(f"{rungs}ladder")
    mechanism = Mechanism.of(scene)
    names = [body.name for body in scene.bodies]

    for k in range(1, 6 * rungs + 1):
        for side, y in (("left", -0.3), ("right", 0.3)):
            rod = names.index(f"{side}{k}")
            assert mechanism.mass[rod] == 1.0
            np.testing.assert_allclose(mechanism.inertia[rod], OWN * np.eye(3), atol=1e-18)
            np.testing.assert_allclose(mechanism.com[rod], [0.0, y, -0.1 * k], atol=1e-15)
    for k in range(1, rungs + 1):
        rung = names.index(f"rung{k}")
        assert mechanism.mass[rung] == 5.0
        np.testing.assert_allclose(
            mechanism.inertia[rung], np.diag([RUNG, 5 * OWN, RUNG]), atol=1e-16
        )
        np.testing.assert_allclose(mechanism.com[rung], [0.0, 0.0, -0.6 * k], atol=1e-15)
    assert mechanism.mass.sum() == 17.0 * rungs
    assert pytest.approx(0.103085) == RUNG


def test_loops_of_the_ladder_are_the_right_ends_of_its_rungs() -> None:
    mechanism = Mechanism.of(load_scene("3ladder"))

    assert [joint.name for joint in mechanism.loops] == [f"rung{k}_right" for k in (1, 2, 3)]
    start = assemble(mechanism)
    rows = constraint_rows(mechanism, start)
    assert np.abs(rows.residual).max() < 1e-15


def _edge_lengths(name: str) -> dict[float, int]:
    """Count the edges of each length at the reference pose."""
    scene = load_scene(name)
    mechanism = Mechanism.of(scene)
    particles = mechanism.com[mechanism.particle_body] + mechanism.particle_offset
    points = np.concatenate([particles, np.array(scene.anchors)])
    first, second = np.array(scene.edges).T
    lengths, counts = np.unique(
        np.linalg.norm(points[first] - points[second], axis=1).round(12), return_counts=True
    )
    return dict(zip(lengths.tolist(), counts.tolist(), strict=True))


def test_edges_are_rods_rungs_and_knots() -> None:
    assert _edge_lengths("6pendulum") == {0.5: 6}
    # Rods of both ropes, 4 pieces of a rung and its 2 ends, all 0.1 m long.
    assert _edge_lengths("3ladder") == {0.1: 2 * 18 + 3 * 6}


def test_edges_of_the_ladder_hang_together() -> None:
    scene = load_scene("2ladder")
    reached, grown = {scene.particle_count}, True
    while grown:
        more = {n for edge in scene.edges if reached & set(edge) for n in edge}
        grown = not more <= reached
        reached |= more

    assert reached == set(range(scene.particle_count + 2))
    assert len(set(map(frozenset, scene.edges))) == len(scene.edges) == 2 * 12 + 2 * 6


@pytest.mark.parametrize("name", ["0pendulum", "-3pendulum", "pendulum", "3ladders", "3.5ladder"])
def test_what_is_no_size_of_a_family_is_refused(name: str) -> None:
    with pytest.raises(UnknownName, match="Npendulum"):
        load_scene(name)


def test_particles_are_the_papers_solid_spheres() -> None:
    particle = load_scene("5pendulum").bodies[0].particles[0]

    radius = math.sqrt(5 * particle.inertia / (2 * particle.mass))

    assert (particle.mass, particle.inertia) == (1.0, OWN)
    assert radius == pytest.approx(0.039275, abs=1e-6)
