"""Mass properties, native frames and the spanning tree, against sums done by hand."""

from __future__ import annotations

import importlib.util
import itertools
import math
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.markers import marker_positions, markers
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.sampling import draw_batch, has_known_forces
from mbds_xsim.scene.scene import (
    Body,
    ContactSphere,
    DistanceLink,
    Ground,
    Inertia,
    Joint,
    Particle,
    Scene,
    SpringDamper,
)
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate.registry import load_scene, write_model
from tests.random_scenes import random_tree

UNIT = Inertia(1.0, (1.0, 1.0, 1.0))
ORIGIN = (0.0, 0.0, 0.0)


def _of(*bodies: Body) -> Mechanism:
    return Mechanism.of(Scene("scene", bodies, 1.0))


def _joint(name: str, kind: Literal["fixed", "hinge", "slider", "ball"], a: str, b: str) -> Joint:
    return Joint(name, kind, a, b, ORIGIN, (0.0, 1.0, 0.0) if kind in ("hinge", "slider") else None)


def test_a_dumbbell_has_its_parallel_axes() -> None:
    mechanism = _of(Body("bar", (Particle((1.0, 0.0, 0.0), 3.0), Particle((5.0, 0.0, 0.0), 1.0))))

    # 3 kg and 1 kg, 4 m apart: reduced mass 0.75 kg; the centre is 1 m from the heavy one.
    own = 2 * 6.17e-4
    assert mechanism.mass.tolist() == [4.0]
    np.testing.assert_allclose(mechanism.com, [[2.0, 0.0, 0.0]])
    np.testing.assert_allclose(mechanism.inertia[0], np.diag([own, 12.0 + own, 12.0 + own]))
    np.testing.assert_allclose(mechanism.particle_offset, [[-1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


def test_mass_properties_of_a_placed_cluster_agree_with_a_sum_in_the_world() -> None:
    rng = np.random.default_rng(1)
    points, masses = rng.standard_normal((6, 3)), rng.uniform(0.5, 2.0, 6)
    inertias = rng.uniform(0.0, 0.1, 6)
    turn = Rotation.random(random_state=2)
    x, y, z, w = turn.as_quat().tolist()
    body = Body(
        "cluster",
        tuple(
            Particle(tuple(p), float(m), float(i))
            for p, m, i in zip(points.tolist(), masses, inertias, strict=True)
        ),
        position=(1.0, -2.0, 3.0),
        orientation=(w, x, y, z),
    )

    mechanism = _of(body)

    placed = turn.apply(points) + np.array([1.0, -2.0, 3.0])
    com = np.average(placed, axis=0, weights=masses)
    tensor = sum(
        m * (np.dot(r, r) * np.eye(3) - np.outer(r, r)) + i * np.eye(3)
        for m, r, i in zip(masses, placed - com, inertias, strict=True)
    )
    np.testing.assert_allclose(mechanism.com[0], com)
    np.testing.assert_allclose(mechanism.inertia[0], tensor, atol=1e-13)
    np.testing.assert_allclose(mechanism.particle_offset, placed - com, atol=1e-14)


def test_an_inertia_given_in_a_turned_frame_turns_with_it() -> None:
    half = math.sqrt(0.5)
    inertia = Inertia(2.0, (1.0, 2.0, 2.5), products=(0.1, 0.2, 0.3), com=(1.0, 0.0, 0.0))

    mechanism = _of(Body("body", inertia=inertia, orientation=(half, 0.0, 0.0, half)))

    # A quarter turn about z: x becomes y, y becomes −x.
    np.testing.assert_allclose(mechanism.com, [[0.0, 1.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(
        mechanism.inertia[0],
        [[2.0, -0.1, -0.3], [-0.1, 1.0, 0.2], [-0.3, 0.2, 2.5]],
        atol=1e-15,
    )


def test_native_rotations_and_published_orientations_are_inverse() -> None:
    rng = np.random.default_rng(3)
    mechanism = Mechanism.of(random_tree(rng, ("free", "hinge", "ball")))
    native = rotation.from_vector(rng.standard_normal((5, 3, 3)))

    published = mechanism.body_orientation(native)

    np.testing.assert_allclose(mechanism.native_rotation(published), native, atol=1e-15)
    # A vector fixed in the body: through the body frame, and through the native one.
    vector = rng.standard_normal(3)
    in_world_then = rotation.rotate(mechanism.reference_orientation, vector)
    np.testing.assert_allclose(
        rotation.rotate(published, vector), rotation.rotate(native, in_world_then), atol=1e-14
    )


def test_particles_move_with_their_body() -> None:
    half = math.sqrt(0.5)
    body = Body(
        "bar",
        (Particle((0.0, 0.0, 0.0)), Particle((2.0, 0.0, 0.0))),
        orientation=(half, 0.0, half, 0.0),
    )
    mechanism = _of(body)

    # The bar along −z at the reference pose; published as unturned, it lies along x.
    lying = mechanism.particle_positions(np.array([[5.0, 0.0, 0.0]]), np.array([[1.0, 0, 0, 0]]))

    np.testing.assert_allclose(mechanism.com, [[0.0, 0.0, -1.0]], atol=1e-15)
    np.testing.assert_allclose(lying, [[4.0, 0.0, 0.0], [6.0, 0.0, 0.0]], atol=1e-15)


def test_points_are_placed_in_native_frames() -> None:
    bodies = (
        Body("a", inertia=Inertia(1.0, (1.0, 1.0, 1.0), com=(1.0, 0.0, 0.0))),
        Body("b", inertia=UNIT, position=(0.0, 2.0, 0.0)),
    )
    points = ((0.0, 0.0, 0.0), (0.0, 2.0, 4.0))
    scene = Scene(
        "scene",
        bodies,
        1.0,
        joints=(Joint("joint", "hinge", "a", "b", (1.0, 1.0, 1.0), (0.0, 0.0, 4.0)),),
        distance_links=(DistanceLink("link", ("a", "world"), points, length=3.0),),
        springs=(SpringDamper("spring", ("world", "b"), points, stiffness=7.0, damping=0.5),),
        contacts=(ContactSphere("b", (0.0, 0.0, 0.0), 0.3),),
        ground=Ground(0.4, 0.9),
    )

    mechanism = Mechanism.of(scene)

    joint, link, spring = mechanism.joints[0], mechanism.distances[0], mechanism.springs[0]
    assert joint.axis.tolist() == [0.0, 0.0, 1.0]
    assert joint.in_parent.tolist() == [0.0, 1.0, 1.0]
    assert joint.in_child.tolist() == [1.0, -1.0, 1.0]
    assert link.bodies == (0, WORLD_INDEX)
    assert [point.tolist() for point in link.in_body] == [[-1.0, 0.0, 0.0], [0.0, 2.0, 4.0]]
    assert link.length == 3.0
    assert spring.length == pytest.approx(math.sqrt(20.0))
    assert (spring.stiffness, spring.damping) == (7.0, 0.5)
    assert spring.in_body[1].tolist() == [0.0, 0.0, 4.0]
    assert mechanism.sphere_offset.tolist() == [[0.0, -2.0, 0.0]]
    assert (mechanism.sphere_body.tolist(), mechanism.sphere_radius.tolist()) == ([1], [0.3])


def test_an_axis_may_have_any_length() -> None:
    body = Body("body", inertia=UNIT)
    joint = Joint("joint", "hinge", "world", "body", ORIGIN, (3e-200, 0.0, 4e-200))

    placed = Mechanism.of(Scene("scene", (body,), 1.0, joints=(joint,))).joints[0]

    np.testing.assert_allclose(placed.axis, [0.6, 0.0, 0.8])


def _ring(*kinds: Literal["fixed", "hinge", "slider", "ball"]) -> Mechanism:
    """Close a ring of bodies through the world: joint k joins body k−1 to body k."""
    names = ["world", *(f"b{k}" for k in range(1, len(kinds)))]
    bodies = tuple(Body(name, inertia=UNIT) for name in names[1:])
    ends = zip(kinds, names, [*names[1:], "world"], strict=True)
    joints = tuple(_joint(f"j{k}", kind, a, b) for k, (kind, a, b) in enumerate(ends))
    return Mechanism.of(Scene("ring", bodies, 1.0, joints=joints))


@pytest.mark.parametrize(
    ("kinds", "cut"),
    [
        (("hinge", "ball", "hinge", "slider"), "j1"),
        (("ball", "hinge", "ball", "fixed"), "j2"),
        (("hinge", "hinge", "slider", "fixed"), "j1"),
        (("slider", "fixed", "slider"), "j2"),
        (("fixed", "fixed"), "j1"),
    ],
)
def test_a_ring_is_cut_at_a_ball_then_a_hinge_the_last_listed(
    kinds: tuple[Literal["fixed", "hinge", "slider", "ball"], ...], cut: str
) -> None:
    mechanism = _ring(*kinds)

    assert [joint.name for joint in mechanism.loops] == [cut]
    in_tree = {link.joint.name for link in mechanism.links if link.joint is not None}
    assert in_tree == {joint.name for joint in mechanism.joints} - {cut}


def test_every_body_has_one_link_and_parents_come_first() -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        kinds = rng.choice(["fixed", "hinge", "slider", "ball", "free"], 9).tolist()
        mechanism = Mechanism.of(random_tree(rng, kinds))

        order = [link.body for link in mechanism.links]
        assert sorted(order) == list(range(9))
        assert not mechanism.loops
        for k, link in enumerate(mechanism.links):
            assert link.parent in [WORLD_INDEX, *order[:k]]
            if link.joint is not None:
                assert (link.joint.parent, link.joint.child) == (link.parent, link.body)


def test_a_joint_listed_against_the_tree_is_turned_around() -> None:
    bodies = (Body("a", inertia=UNIT), Body("b", inertia=UNIT, position=(1.0, 0.0, 0.0)))
    joints = (
        Joint("inner", "hinge", "a", "world", ORIGIN, (0.0, 0.0, 1.0)),
        Joint("outer", "slider", "b", "a", (2.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    )

    mechanism = Mechanism.of(Scene("scene", bodies, 1.0, joints=joints))

    inner, outer = (link.joint for link in mechanism.links)
    assert inner is not None
    assert outer is not None
    assert (inner.parent, inner.child, inner.axis.tolist()) == (WORLD_INDEX, 0, [0.0, 0.0, -1.0])
    assert (outer.parent, outer.child, outer.axis.tolist()) == (0, 1, [0.0, -1.0, 0.0])
    assert outer.in_parent.tolist() == [2.0, 0.0, 0.0]
    assert outer.in_child.tolist() == [1.0, 0.0, 0.0]
    assert [joint.parent for joint in mechanism.joints] == [0, 1]


def test_a_scene_is_built_once() -> None:
    first, second = _ring("hinge", "hinge"), _ring("hinge", "hinge")

    assert first is second


class _Counted(str):
    """A name that counts comparisons."""

    comparisons = 0
    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        _Counted.comparisons += 1
        return str.__eq__(self, other)


def _comparisons(joints: int) -> int:
    """Count the comparisons of names that it takes to build driven hinges in a chain of gears."""
    names, before = [f"j{k}" for k in range(joints)], _Counted.comparisons
    scene = Scene(
        "gears",
        tuple(Body(name, inertia=UNIT) for name in names),
        1.0,
        joints=tuple(_joint(_Counted(name), "hinge", "world", name) for name in names),
        servos=tuple(Servo(_Counted(name), stiffness=1.0) for name in names),
        couplings=tuple(
            Coupling(_Counted(own), _Counted(other)) for other, own in itertools.pairwise(names)
        ),
    )
    assert Mechanism.of(scene).joints[-1].coupled
    assert not has_known_forces(scene)
    if importlib.util.find_spec("pxr"):
        write_model(scene, "usda")
    return _Counted.comparisons - before


def test_joints_find_their_servos_and_couplings_with_work_in_proportion_to_their_number() -> None:
    assert _comparisons(200) < 5 * _comparisons(50)


def test_particles_without_extent_on_a_line_are_refused() -> None:
    body = Body("rod", tuple(Particle((0.0, 0.0, z), 1.0, 0.0) for z in (0.0, 1.0)))

    with pytest.raises(SceneError, match=r"'rod'.*principal inertia"):
        _of(body)


def test_particles_are_the_markers_where_every_body_has_some() -> None:
    mechanism, batch = Mechanism.of(load_scene("2ladder")), draw_batch(load_scene("2ladder"), [4])
    native = mechanism.native_rotation(batch.orientation)
    np.testing.assert_array_equal(
        marker_positions(mechanism, batch.position, native),
        mechanism.particle_positions(batch.position, batch.orientation),
    )


def test_a_turn_of_a_body_without_particles_shows() -> None:
    mechanism = Mechanism.of(load_scene("workbench"))
    body, offset = markers(mechanism)
    for bare in np.flatnonzero(mechanism.particles_per_body == 0):
        star = offset[body == bare]
        assert len(star) == 6
        # Masses at the markers have the body's centre of mass and mean moment of inertia.
        np.testing.assert_allclose(star.mean(axis=0), 0.0, atol=1e-15)
        moment = 2.0 * mechanism.mass[bare] * np.mean(np.sum(star**2, axis=1))
        np.testing.assert_allclose(moment, np.trace(mechanism.inertia[bare]))
