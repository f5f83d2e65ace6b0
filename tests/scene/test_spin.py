"""Bodies that never spin, and how their orientation follows from their axis."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, DistanceLink, Inertia, Joint, Particle, Scene
from mbds_xsim.scene.spin import carried, idle_axes
from mbds_xsim.simulate.registry import load_scene

PAIR = (Particle((0.0, 0.0, -0.5)), Particle((0.0, 0.0, -1.0)))
BALL = (Joint("joint", "ball", "world", "rod", (0.0, 0.0, 0.0)),)


def hung(**changes: object) -> Scene:
    rod = Body("rod", particles=PAIR)
    return msgspec.structs.replace(Scene("hung", (rod,), joints=BALL, length=1.0), **changes)


def test_rods_of_pendulums_and_ropes_never_spin_and_rungs_do() -> None:
    assert idle_axes(load_scene("6pendulum")).any(axis=1).all()
    ladder = load_scene("2ladder")
    spinning = np.flatnonzero(~idle_axes(ladder).any(axis=1))
    assert [ladder.bodies[k].name for k in spinning] == ["rung1", "rung2"]


@pytest.mark.parametrize("name", ["ballscroll", "balldrop", "particlecar", "simplecubli"])
def test_what_touches_the_ground_may_be_turned(name: str) -> None:
    assert not idle_axes(load_scene(name)).any()


def test_a_rod_in_the_air_is_idle_and_points_along_itself() -> None:
    np.testing.assert_allclose(np.abs(idle_axes(hung())), [[0.0, 0.0, 1.0]], atol=1e-15)


@pytest.mark.parametrize(
    "changes",
    [
        {"joints": (msgspec.structs.replace(BALL[0], kind="hinge", axis=(1.0, 0.0, 0.0)),)},
        {"joints": (msgspec.structs.replace(BALL[0], anchor=(0.01, 0.0, 0.0)),)},
        {
            "distance_links": (
                DistanceLink("beside", ("world", "rod"), ((1.0, 0.0, -1.0), (0.01, 0.0, -1.0))),
            )
        },
        {"bodies": (Body("rod", particles=(*PAIR, Particle((0.01, 0.0, -0.7)))),)},
        {"bodies": (Body("rod", inertia=Inertia(1.0, (0.1, 0.11, 0.02), com=(0.0, 0.0, -0.7))),)},
    ],
    ids=["hinge", "joint off the axis", "link off the axis", "particle off the axis", "uneven"],
)
def test_what_can_be_turned_about_its_axis_is_not_idle(changes: dict[str, object]) -> None:
    assert not idle_axes(hung(**changes)).any()


def on_a_cone(opening: float, rate: float, frames: int, interval: float) -> BodyStates:
    """An axis that goes round a cone, on a body that turns about it at random."""
    angle = rate * interval * np.arange(frames)
    circle = rotation.from_vector(angle[:, None] * np.array([0.0, 0.0, 1.0]))
    tilt = rotation.from_vector(np.array([opening, 0.0, 0.0]))
    native = rotation.multiply(circle, tilt)[:, None, :]
    twist = np.random.default_rng(0).normal(size=(frames, 1, 1))
    axis = rotation.rotate(native, np.array([0.0, 0.0, 1.0]))
    across = np.array([0.0, 0.0, rate]) - rate * np.cos(opening) * axis
    native = rotation.multiply(native, rotation.from_vector(twist * np.array([0.0, 0.0, 1.0])))
    nothing = np.zeros((frames, 1, 3))
    return BodyStates(nothing, native, nothing, across + twist * axis)


def test_an_axis_that_went_round_a_cone_has_turned_by_the_solid_angle() -> None:
    """The turn is 2π (1 − cos θ), the sphere's holonomy, to fourth order in the interval."""
    axes, opening = np.array([[0.0, 0.0, 1.0]]), 0.7
    errors = []
    for frames in (20, 40, 80):
        motion = on_a_cone(opening, 2.0 * np.pi, frames + 1, 1.0 / frames)
        start = rotation.from_vector(np.array([[opening, 0.0, 0.0]]))
        end = carried(axes, start, motion, 1.0 / frames)
        turned = rotation.multiply(rotation.conjugate(start), end.native[-1])
        solid = rotation.angle_about(turned, axes) - 2.0 * np.pi * (1.0 - np.cos(opening))
        errors.append(float(np.abs(np.sin(solid[0] / 2)) * 2))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders.min() > 3.8
    assert errors[-1] < 1e-6


def test_orientation_of_rods_follows_from_their_axes_as_the_reference_has_it() -> None:
    scene = load_scene("2pendulum")
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, [0, 1])
    exact = reference.solve(scene, batch, cache=False)
    native = mechanism.native_rotation(exact.orientation)
    twisted = rotation.multiply(native, rotation.from_vector(np.array([0.0, 0.0, 0.3])))
    bodies = BodyStates(exact.position, twisted, exact.velocity, exact.angular_velocity)
    again = carried(idle_axes(scene), native[:, 0], bodies, scene.clock.frame)
    apart = rotation.to_vector(rotation.multiply(rotation.conjugate(native), again.native))
    assert np.abs(apart).max() < 1e-4
    np.testing.assert_allclose(again.angular_velocity, exact.angular_velocity, atol=1e-9)
