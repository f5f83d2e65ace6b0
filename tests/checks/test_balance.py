"""Forces that contact cannot explain show, in a frame or in the sum; others do not."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.checks.audit import audited
from mbds_xsim.checks.balance import balance, balance_drift, cones
from mbds_xsim.checks.finding import Finding
from mbds_xsim.checks.friction import friction, rolling
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.straight_car import straight_run


@pytest.fixture(scope="module")
def driven() -> tuple[Scene, Batch, Trajectory]:
    """A car in closed form that slips at first, and rolls for most of 2 s."""
    scene = load_scene("particlecar")
    scene = msgspec.structs.replace(scene, noise=0.0, clock=Clock(scene.clock.frame, 100))
    torque = np.repeat([[2.0, -1.0], [-0.5, 2.0]], 50, axis=0)
    return scene, *straight_run(scene, speed=10.0, rates=(45.0, 55.0), torque=torque)


def _both(scene: Scene, batch: Batch, motion: Trajectory) -> tuple[Finding, Finding]:
    record = Record(scene, batch, motion)
    return balance.finding(record), balance_drift.finding(record)


def _turned(motion: Trajectory, angle: float) -> Trajectory:
    """Turn the motion about z, as a turned observer would see it."""
    turn = rotation.from_vector(np.array([0.0, 0.0, angle]))
    vectors = ("position", "velocity", "angular_velocity")
    changes: dict[str, Any] = {
        name: rotation.rotate(turn, getattr(motion, name)) for name in vectors
    }
    quaternion = rotation.multiply(turn, motion.orientation)
    return dataclasses.replace(motion, **changes, orientation=quaternion)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
def test_contact_explains_a_car_in_any_heading(
    driven: tuple[Scene, Batch, Trajectory], angle: float
) -> None:
    scene, batch, motion = driven
    each, drift = _both(scene, batch, _turned(motion, angle))

    assert each.figure.max() < 1e-9
    assert drift.figure.max() < 1e-9


def test_a_small_torque_on_an_axle_adds_up(driven: tuple[Scene, Batch, Trajectory]) -> None:
    """The motion lacks 0.01 N·m on each axle; all four together would move the car."""
    scene, batch, motion = driven
    stronger = dataclasses.replace(batch, torque=batch.torque + 0.01)
    each, drift = _both(scene, stronger, motion)

    assert each.passed.all()
    assert not drift.passed.any()
    # The impulses on the wheels, each 0.01 N·m · 20 ms over a radius of 0.2 m, are 1 mN·s. They
    # are shared out evenly between the car's own momentum and the four spins.
    mass = 20.0 + 4.0 * 13.0
    assert drift.figure == pytest.approx(100 * 4e-3 / 5.0 / (mass * 9.81 * 0.02), rel=1e-6)


def test_drag_shows_along_the_heading(driven: tuple[Scene, Batch, Trajectory]) -> None:
    scene, batch, motion = driven
    force = batch.force.copy()
    force[:, 60, 0, 0] += 5.0
    each, _ = _both(scene, dataclasses.replace(batch, force=force), motion)

    assert not each.passed.any()
    assert (each.frame == 61).all()


def test_what_friction_can_explain_does_not_show(driven: tuple[Scene, Batch, Trajectory]) -> None:
    """Friction of the wheels could balance a force across them."""
    scene, batch, motion = driven
    force = batch.force.copy()
    force[:, 60, 0, 1] += 5.0
    each, drift = _both(scene, dataclasses.replace(batch, force=force), motion)

    assert each.figure.max() < 1e-9
    assert drift.figure.max() < 1e-9


def test_a_force_shows_in_flight() -> None:
    """Nothing balances a force of one frame on a ball in the air."""
    scene = load_scene("balldrop")
    scene = msgspec.structs.replace(scene, clock=Clock(scene.clock.frame, 60))
    batch = draw_batch(scene, range(2))
    motion = reference.solve(scene, batch, cache=False)
    force = batch.force.copy()
    force[:, 5, 0, 0] += 1.0
    finding = balance.finding(Record(scene, dataclasses.replace(batch, force=force), motion))

    assert (finding.frame == 6).all()
    assert finding.figure == pytest.approx(1.0 / (19.0 * 9.81), rel=1e-6)
    assert set(finding.where) == {"impulse, disc"}


@pytest.mark.parametrize("mu", [0.0, 0.124544])
def test_contact_explains_a_ball_that_turns_about_all_axes(mu: float) -> None:
    """Its slip grows again while friction could stop it, were its moments equal."""
    radius, turn = 0.0331292, np.array([0.1746205, -0.0944141, 0.859288, 0.4713999])
    ball = Body(
        "ball", inertia=Inertia(0.461931, (1.52097e-4, 2.02796e-4, 2.53495e-4)),
        position=(0.0, 0.0, radius), orientation=tuple((turn / np.linalg.norm(turn)).tolist()),
        velocity=(-0.2993, -1.223589, 0.0), angular_velocity=(7.676261, -10.971915, 9.230195),
    )  # fmt: skip
    touch = ContactSphere("ball", (0.0, 0.0, radius), radius)
    law, clock = Ground(mu, 0.0), Clock(0.02, 25)
    scene = Scene("ball", (ball,), 1.0, contacts=(touch,), ground=law, clock=clock)
    batch = draw_batch(scene, [0])
    record = Record(scene, batch, reference.solve(scene, batch, cache=False))
    assert max(each.finding(record).figure.max() for each in (balance, cones, rolling)) < 1e-7


@pytest.mark.parametrize(
    ("mu", "radius", "inertia", "turn", "velocity", "spin"),
    [
        (0.621, 0.06753, Inertia(6.3346, (0.004183, 0.004185, 0.0076)),
         (-0.24, 0.113, -0.71, -0.652), (-2.8543, 2.3106, 0.0), (-40.471, -36.036, 1.409)),
        (0.273, 0.01228, Inertia(5.6521, (2.75e-4, 2.181e-4, 3.849e-4)),
         (0.512, 0.535, 0.118, -0.661), (-2.6469, 0.5441, 0.0), (49.029, -128.121, 6.128)),
        (0.17039, 0.059535, Inertia(1.0, (1.095e-3, 1.0366e-4, 1.0544e-3)),
         (-0.7613, 0.0, 0.0, 0.6484), (0.15035, 0.40649, 0.0), (-0.0748, 0.02634, 40.524)),
    ],
    ids=["rolls", "slips", "sways"],
)  # fmt: skip
def test_uneven_balls_that_turn_far_in_a_frame_are_sound(
    mu: float, radius: float, inertia: Inertia, turn: Any, velocity: Any, spin: Any
) -> None:
    """Between two frames their slip grows most, turns aside, or sways as their moments turn."""
    place, orientation = (0.0, 0.0, radius), tuple((turn / np.linalg.norm(turn)).tolist())
    ball = Body(
        "ball", inertia=inertia, position=place, orientation=orientation,
        velocity=velocity, angular_velocity=spin,
    )  # fmt: skip
    touch = ContactSphere("ball", place, radius)
    law, clock = Ground(mu, 0.0), Clock(0.04, 2)
    scene = Scene("ball", (ball,), 1.0, contacts=(touch,), ground=law, clock=clock)
    batch = draw_batch(scene, [0])
    record = Record(scene, batch, reference.solve(scene, batch, cache=False))
    assert max(one.figure.max() for one in audited(record, (friction, rolling))) < 1e-7


def test_a_ball_that_turns_about_a_principal_axis_is_judged_whatever_its_other_moments() -> None:
    """Its slip of 0.15 m/s changes like that of a ball with equal moments, and ends in a frame."""
    ball = Body(
        "ball", inertia=Inertia(0.46, (1.5e-4, 2.0e-4, 2.5e-4)), position=(0.0, 0.0, 0.033),
        velocity=(1.0, 0.0, 0.0), angular_velocity=(0.0, 0.85 / 0.033, 0.0),
    )  # fmt: skip
    touch = ContactSphere("ball", (0.0, 0.0, 0.033), 0.033)
    scene, smooth = (
        Scene("ball", (ball,), 1.0, contacts=(touch,), ground=Ground(mu, 0.0), clock=Clock(0.02, 4))
        for mu in (0.15, 0.12)
    )
    batch = draw_batch(scene, [0])
    sound, weak = (reference.solve(each, batch, cache=False) for each in (scene, smooth))
    faster = sound.velocity.copy()
    faster[:, 3:] *= 1.01
    creeping = dataclasses.replace(sound, velocity=faster)

    def figures(motion: Trajectory) -> list[float]:
        record = Record(scene, batch, motion)
        return [float(each.finding(record).figure.max()) for each in (friction, rolling)]

    assert max(figures(sound)) < 1e-9
    assert figures(weak)[0] == pytest.approx(0.2, abs=1e-3)
    assert figures(creeping)[1] == pytest.approx(0.01, rel=0.1)
