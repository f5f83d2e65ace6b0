"""Inertias that joints move, against the mass matrix of two rods and the reference."""

from __future__ import annotations

import numpy as np

from mbds_xsim import reference
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.joint_inertia import closed_inertias, kicks, moved_inertias, poses
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.simulate.registry import load_scene

MASS, LENGTH, MOMENT, ROTOR = 0.7, 0.4, 0.02, 0.03


def _arm() -> Mechanism:
    rod = Inertia(MASS, (1e-3, MOMENT, MOMENT))
    bodies = tuple(
        Body(name, inertia=rod, position=(x * LENGTH, 0, 0)) for name, x in (("a", 0.5), ("b", 1.5))
    )
    joints = (
        Joint("shoulder", "hinge", "world", "a", (0, 0, 0), (0, -1, 0), armature=ROTOR),
        Joint("elbow", "hinge", "a", "b", (LENGTH, 0, 0), (0, -1, 0), limits=(-0.5, 1.5)),
    )
    return Mechanism.of(Scene("arm", bodies, 1.0, joints=joints))


def _bent(mechanism: Mechanism, elbow: Array) -> BodyStates:
    links = to_links(mechanism, assemble(mechanism).each(lambda v: np.stack([v] * len(elbow))))
    links.coordinate[:, 1] = elbow
    return to_bodies(mechanism, links)


def _mass_matrix(elbow: Array) -> Array:
    """Mass matrix of two rods in a plane, with centres in their middles."""
    end, cross = MOMENT + MASS * LENGTH**2 / 4, MASS * LENGTH**2 / 2 * np.cos(elbow)
    whole = 2 * end + MASS * LENGTH**2 + 2 * cross + ROTOR
    return np.moveaxis(np.array([[whole, end + cross], [end + cross, end + 0 * cross]]), -1, 0)


def test_joints_move_what_the_mass_matrix_says() -> None:
    mechanism, elbow = _arm(), np.linspace(-3.0, 3.0, 7)

    least, most = moved_inertias(mechanism, mechanism.joints, _bent(mechanism, elbow))

    mass = _mass_matrix(elbow)
    np.testing.assert_allclose(most, np.diagonal(mass, axis1=1, axis2=2), rtol=1e-12)
    yielding = np.diagonal(np.linalg.inv(mass), axis1=1, axis2=2)
    np.testing.assert_allclose(least, 1.0 / yielding, rtol=1e-12)


def test_a_kick_moves_bodies_as_a_torque_does() -> None:
    """A torque on each of three wheels changes accelerations as its kick changes velocities."""
    mechanism = Mechanism.of(load_scene("simplecubli"))
    start = assemble(mechanism)
    least, _ = moved_inertias(mechanism, mechanism.hinges, start)
    changes = kicks(mechanism, mechanism.hinges, start)

    loads = np.eye(len(mechanism.hinges))
    still, batch = np.zeros((3, mechanism.body_count, 3)), start.each(lambda v: np.stack([v] * 3))
    pushed = reference.accelerations(mechanism, batch, still, loads)
    loose = reference.accelerations(mechanism, batch, still, 0.0 * loads)
    for kick, with_torque, without in zip(changes, pushed, loose, strict=True):
        np.testing.assert_allclose(kick, (with_torque - without) * least[:, None, None], atol=1e-10)


def test_what_follows_a_joint_counts_at_both() -> None:
    """A slider of 2 kg follows a wheel of 0.02 kg·m² by 0.3 m/rad, and another that by -2."""
    ball = Inertia(2.0, (0.02,) * 3)
    bodies = tuple(Body(name, inertia=ball) for name in ("wheel", "block", "end"))
    joints = (
        Joint("end", "slider", "world", "end", (0, 0, 0), (0, 1, 0)),
        Joint("rail", "slider", "block", "world", (0, 0, 0), (1, 0, 0)),
        Joint("axle", "hinge", "world", "wheel", (0, 0, 0), (0, 0, 1)),
    )
    gears = (Coupling("end", "rail", -2.0), Coupling("rail", "axle", 0.3))
    mechanism = Mechanism.of(Scene("gears", bodies, 1.0, joints=joints, couplings=gears))
    start = assemble(mechanism)

    whole = 0.02 + 2.0 * 0.3**2 + 2.0 * 0.6**2
    due = [whole / 0.6**2, whole / 0.3**2, whole]
    for inertia in moved_inertias(mechanism, mechanism.joints, start):
        np.testing.assert_allclose(inertia, due, rtol=1e-12)
    moving, turning = kicks(mechanism, mechanism.joints, start)
    np.testing.assert_allclose(moving[2], [(0, 0, 0), (-0.3, 0, 0), (0, -0.6, 0)], atol=1e-12)
    np.testing.assert_allclose(turning[:, 0, 2], [-1 / 0.6, 1 / 0.3, 1.0], rtol=1e-12)


def test_closed_loops_add_what_they_move() -> None:
    """The crank of a parallelogram moves the coupler along, and turns the rocker."""
    rod, axis = Inertia(MASS, (MOMENT,) * 3), (0, 1, 0)
    places = {"crank": (0, 0, 0.15), "coupler": (0.2, 0, 0.3), "rocker": (0.4, 0, 0.15)}
    bodies = tuple(Body(name, inertia=rod, position=at) for name, at in places.items())
    pins: tuple[tuple[str, str, tuple[float, float, float]], ...] = (
        ("world", "crank", (0, 0, 0)),
        ("crank", "coupler", (0, 0, 0.3)),
        ("world", "rocker", (0.4, 0, 0)),
        ("coupler", "rocker", (0.4, 0, 0.3)),
    )
    joints = tuple(Joint(f"{a} {b}", "hinge", a, b, at, axis) for a, b, at in pins)
    mechanism = Mechanism.of(Scene("four-bar", bodies, 1.0, joints=joints))

    inertia = closed_inertias(mechanism, mechanism.joints[:1])
    np.testing.assert_allclose(inertia, 2 * (MOMENT + MASS * 0.15**2) + MASS * 0.3**2, rtol=1e-9)


def test_poses_are_the_start_and_others_within_limits() -> None:
    mechanism = _arm()
    states, elbow = poses(mechanism), mechanism.joints[1]

    np.testing.assert_array_equal(states.position[0], assemble(mechanism).position)
    angle = joint_coordinate(elbow, states.position, states.native)
    assert -0.5 <= angle.min() < -0.3
    assert 1.3 < angle.max() <= 1.5
