"""Contact of bodies on which dampers, servos, joints to the world or other bodies act, too."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks import Finding, Record, audit
from mbds_xsim.checks.displacement import displacement
from mbds_xsim.checks.passivity import passivity
from mbds_xsim.reference import solve
from mbds_xsim.scene.collisions import Collisions
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    ContactSphere,
    Ground,
    Inertia,
    Joint,
    Scene,
    SpringDamper,
)
from mbds_xsim.scene.servo import Servo
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import simulate

RK4 = load_adapter("mujoco").methods["RK4"]
PULL, FRAME, TOP, STIFFNESS, REST, RADIUS = 9.81, 0.02, 2.0, 400.0, 0.08, 0.05
CORNERS = [(x, y) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]


def _strut(steps: int = 50, servos: tuple[Servo, ...] = (), **strut: Any) -> Scene:
    """Stand a body on a plate that lies on the ground, with a slider between them."""
    return Scene(
        name="strut",
        bodies=(
            Body("plate", inertia=Inertia(5.0, (0.05, 0.05, 0.1)), position=(0.0, 0.0, RADIUS)),
            Body("top", inertia=Inertia(TOP, (0.02,) * 3), position=(0.0, 0.0, 0.4)),
        ),
        joints=(
            Joint("strut", "slider", "plate", "top", (0.0, 0.0, 0.2), (0.0, 0.0, 1.0), **strut),
        ),
        servos=servos,
        contacts=tuple(ContactSphere("plate", (x, y, RADIUS), RADIUS) for x, y in CORNERS),
        ground=Ground(0.5, 0.0),
        length=0.5,
        clock=Clock(FRAME, steps),
    )


def _times(steps: int) -> Array:
    """Return the times of frames."""
    return np.linspace(0.0, FRAME * steps, steps + 1)


def _risen(scene: Scene, height: Array, speed: Array) -> Finding:
    """Check a motion in which the plate lies still, and the top is at a height over its start."""
    batch = draw_batch(scene, [0])
    place = np.repeat(batch.position[:, None], len(height), axis=1)
    place[0, :, 1, 2] += height
    velocity = np.zeros_like(place)
    velocity[0, :, 1, 2] = speed
    turn = np.repeat(batch.orientation[:, None], len(height), axis=1)
    time = _times(len(height) - 1)
    motion = Trajectory(time, place, turn, velocity, np.zeros_like(place), (None,))
    return passivity.finding(Record(scene, batch, motion, RK4, 1e-3, contact_time=1e-3))


def _swung(damping: float) -> tuple[Array, Array]:
    """Return heights and speeds of the top on its spring, from rest at the spring's start."""
    time, middle = _times(50), REST - TOP * PULL / STIFFNESS
    decay = 0.5 * damping / TOP
    rate = math.sqrt(STIFFNESS / TOP - decay**2)
    fade, cosine, sine = np.exp(-decay * time), np.cos(rate * time), np.sin(rate * time)
    height = middle * (1.0 - fade * (cosine + decay / rate * sine))
    return height, middle * fade * (rate + decay**2 / rate) * sine


def test_a_damper_that_is_left_out_on_the_ground_shows() -> None:
    scene = _strut(stiffness=STIFFNESS, damping=4.0, rest=REST)
    right, weak, missing = (_risen(scene, *_swung(damping)) for damping in (4.0, 2.0, 0.0))

    assert right.passed.all(), right.line(0)
    assert right.figure.max() < 5e-4
    assert not weak.passed.any()
    assert not missing.passed.any()


def test_what_a_limited_servo_lifts_on_the_ground_passes() -> None:
    """The servo always pushes as hard as it can, so that the top rises evenly faster."""
    limit, time = 30.0, _times(20)
    gain = limit / TOP - PULL
    scene = _strut(20, (Servo("strut", velocity=(100.0,), damping=100.0, limit=limit),))
    right = _risen(scene, 0.5 * gain * time**2, gain * time)
    high = _risen(scene, 0.55 * gain * time**2, 1.1 * gain * time)

    assert right.figure.max() < 1e-9
    assert not high.passed.any()


def _bouncing(height: float, steps: int, restitution: float = 0.8, **more: Any) -> Scene:
    """Drop a ball from a height."""
    centre = (0.0, 0.0, RADIUS + height)
    return Scene(
        name="bouncing",
        bodies=(Body("bob", inertia=Inertia(1.0, (1e-3,) * 3), position=centre),),
        contacts=(ContactSphere("bob", centre, RADIUS),),
        ground=Ground(0.0, restitution),
        length=1.0,
        clock=Clock(FRAME, steps),
        **more,
    )


def _bounced(height: float, restitution: float, steps: int) -> Trajectory:
    """Return the exact motion of a ball that bounces until its bounces have died out."""
    z, speed, rows = height, 0.0, [(height, 0.0)]
    for _ in range(steps):
        left = FRAME
        while (fall := (speed + math.sqrt(speed**2 + 2 * PULL * z)) / PULL) < left:
            z, speed, left = 0.0, restitution * (PULL * fall - speed), left - fall
            if speed < 1e-6:
                speed = left = 0.0
                break
        z, speed = max(z + speed * left - 0.5 * PULL * left**2, 0.0), speed - PULL * left
        rows.append((z, speed))
    place = np.zeros((1, steps + 1, 1, 3))
    velocity = np.zeros_like(place)
    place[0, :, 0, 2], velocity[0, :, 0, 2] = np.transpose(rows)
    place[..., 2] += RADIUS
    turn = np.zeros((1, steps + 1, 1, 4))
    turn[..., 0] = 1.0
    return Trajectory(_times(steps), place, turn, velocity, np.zeros_like(place), (None,))


@pytest.mark.parametrize(("height", "restitution"), [(0.2, 0.8), (1.0, 0.7)])
def test_what_the_world_holds_may_bounce_on_the_ground(height: float, restitution: float) -> None:
    """The ground's impulse on it is unknown, and with it how long it was on its way up."""
    start = (0.0, 0.0, RADIUS + height)
    rail = Joint("rail", "slider", "world", "bob", start, (0.0, 0.0, 1.0))
    held = SpringDamper("stay", ("world", "bob"), ((0.0, 0.0, 2.0), start), 0.0, 0.0, 1.0)
    motion = _bounced(height, restitution, 150)
    for more in ({}, {"joints": (rail,)}, {"springs": (held,)}):
        scene = _bouncing(height, 150, restitution, **more)
        findings = audit(scene, draw_batch(scene, [0]), motion, RK4, step=1e-4, contact_time=1e-4)
        failed = [finding.line(0) for finding in findings if not finding.passed.all()]
        assert not failed, failed


def test_what_the_world_holds_must_move_as_it_says_in_flight() -> None:
    rail = Joint("rail", "slider", "world", "bob", (0.0, 0.0, 0.85), (0.0, 0.0, 1.0))
    scene, motion = _bouncing(0.8, 150, joints=(rail,)), _bounced(0.8, 0.8, 150)
    motion.position[0, 5:15, 0, 2] += 0.1 * _times(9)
    record = Record(scene, draw_batch(scene, [0]), motion, RK4, 1e-4, contact_time=1e-4)

    assert not displacement.finding(record).passed.any()


def _by_mujoco(scene: Scene) -> tuple[Trajectory, list[Finding]]:
    """Simulate a scene by MuJoCo and check it."""
    pytest.importorskip("mujoco")
    adapter, batch = load_adapter("mujoco"), draw_batch(scene, [0])
    settings = settings_for(scene, adapter, "matched")
    made = simulate(scene, batch, "mujoco", settings)
    method, time = adapter.methods[settings.method], made.contact_time
    motion = made.trajectory
    return motion, audit(scene, batch, motion, method, step=settings.step, contact_time=time)


def test_a_collision_may_turn_a_wheel() -> None:
    """A ball hits a wheel off its middle, above the ground: friction gives it spin."""
    hub, start = (0.0, 0.0, 50.0), (-0.6, 0.0, 50.12)
    scene = Scene(
        name="hit",
        bodies=(
            Body("hull", inertia=Inertia(3.0, (0.05,) * 3), position=(0.0, 0.4, 50.0)),
            Body("wheel", inertia=Inertia(1.0, (0.01, 0.02, 0.01)), position=hub),
            Body("ball", inertia=Inertia(0.5, (5e-4,) * 3), position=start, velocity=(3, 0, 0)),
        ),
        joints=(Joint("axle", "hinge", "hull", "wheel", hub, (0.0, 1.0, 0.0)),),
        contacts=(ContactSphere("wheel", hub, 0.2), ContactSphere("ball", start, 0.05)),
        ground=Ground(0.5, 0.5),
        collisions=Collisions((("wheel", "ball"),), 0.4, 0.8),
        length=1.0,
        clock=Clock(FRAME, 15),
    )
    motion, findings = _by_mujoco(scene)

    assert abs(motion.angular_velocity[0, -1, 1, 1]) > 1.0
    failed = [finding.line(0) for finding in findings if not finding.passed.all()]
    assert not failed, failed


def _pegged(stiffness: float, damping: float, *, peg: bool, friction: float = 0.4) -> Scene:
    """Hang a bob on a hinge, high above the ground, beside a peg that stands on it."""
    bodies = [Body("bob", inertia=Inertia(1.0, (0.01,) * 3), position=(0.0, 0.0, 2.0))]
    law: dict[str, Any] = {"stiffness": stiffness, "damping": damping, "start": 1.0}
    joints = [Joint("pivot", "hinge", "world", "bob", (0.0, 0.0, 3.0), (0.0, 1.0, 0.0), **law)]
    spheres = [ContactSphere("bob", (0.0, 0.0, 2.0), 0.1)]
    if peg:
        bodies.append(Body("peg", inertia=Inertia(1.0, (0.01,) * 3), position=(5.0, 0.0, 0.1)))
        joints.append(Joint("weld", "fixed", "world", "peg", (5.0, 0.0, 0.0)))
        spheres.append(ContactSphere("peg", (5.0, 0.0, 0.1), 0.12))
    return Scene(
        "pegged",
        tuple(bodies),
        1.0,
        joints=tuple(joints),
        contacts=tuple(spheres),
        ground=Ground(friction, 0.5),
        clock=Clock(FRAME, 60),
    )


@pytest.mark.parametrize("peg", [False, True])
def test_a_sphere_fixed_on_the_ground_hides_nothing(peg: bool) -> None:
    """It cannot move, so the ground does not hit it."""
    scene, wrong = _pegged(20.0, 0.0, peg=peg), _pegged(15.0, 0.3, peg=peg)
    failed = []
    for made in (scene, wrong):
        batch = draw_batch(made, [0])
        motion = solve(made, batch, cache=False)
        assert motion.failures == (None,)
        findings = audit(scene, draw_batch(scene, [0]), motion, RK4, step=1e-4, contact_time=1e-4)
        failed.append({finding.check for finding in findings if not finding.passed.all()})

    assert failed[0] == set()
    assert {"kinematics", "energy", "coefficients"} <= failed[1]


def test_a_sphere_fixed_on_the_ground_takes_mujoco_no_accuracy() -> None:
    """Steps with contact are of first order, and those of the bob's swing need not be."""
    _, findings = _by_mujoco(_pegged(20.0, 0.0, peg=True, friction=0.0))

    failed = [finding.line(0) for finding in findings if not finding.passed.all()]
    assert not failed, failed
    assert max(finding.figure.max() for finding in findings if finding.check == "energy") < 1e-6
