"""Cases on the ground with exact answers: sliding, rolling, impacts, rest, a driven car.

Answers are closed forms of Coulomb's friction, Newton's restitution and rigid bodies. The allowed
error follows from the resolution that an engine declares for its contact (`ContactScales` of
`mbds_xsim.simulate.adapter`): an impulse of the ground may be late, or early, by one such time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.spheres import spheres_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    GRAVITY,
    PARTICLE_RADIUS,
    Body,
    Clock,
    ContactSphere,
    Ground,
    Inertia,
    Particle,
    Scene,
    Vector,
)
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.claims import ContactScales
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.straight_car import straight_run

RADIUS = PARTICLE_RADIUS
FRICTION, RESTITUTION = 0.43, 0.9332
RESTITUTIONS = (0.0, 0.5, RESTITUTION, 1.0)
_GROUND = Ground(FRICTION, RESTITUTION)
_G = -GRAVITY[2]
_STILL = (0.0, 0.0, 0.0)
_ROUNDING = 1e-9  # [m]
_HEADINGS = (0.0, 0.4, np.pi / 4, 2.0)
_STARTS = ((7.0, 0.0), (9.3, 0.4), (2.0, -1.5), (1.0, 2.5))


@dataclass(frozen=True, eq=False)
class ContactCase:
    """A scene, its start and inputs, the exact motion, and the allowed error."""

    verifies: str
    scene: Scene
    batch: Batch
    exact: Trajectory
    """Exact motion; fields that are not known are NaN."""
    drift: Array
    """Displacement of bodies per time shift of the ground's impulses [m/s], shape (frame,)."""
    creep: Array
    """Displacement of bodies per slip that friction does not stop [s], shape (frame,)."""

    def allowed(self, scales: ContactScales) -> Array:
        """Return the largest allowed distance from the exact position [m], shape (frame,)."""
        # A sphere falls a little before the ground carries it.
        sink = _G * scales.time**2
        return _ROUNDING + sink + self.drift * scales.time + self.creep * scales.slip


def on_ground(
    body: Body,
    length: float,
    centres: list[Any],
    ground: Ground,
    clock: Clock,
    gravity: Vector = GRAVITY,
) -> Scene:
    """Put a body with contact spheres of a particle's radius on the ground."""
    spheres = tuple(ContactSphere(body.name, (x, y, z), RADIUS) for x, y, z in centres)
    return Scene(
        body.name, (body,), length, gravity=gravity, contacts=spheres, ground=ground, clock=clock
    )


def ball(
    height: float = 0.0,
    velocity: Vector = _STILL,
    spin: Vector = _STILL,
    ground: Ground = _GROUND,
    steps: int = 50,
    gravity: Vector = GRAVITY,
) -> Scene:
    """Make one particle with its lowest point at a height [m]."""
    centre = (0.0, 0.0, RADIUS + height)
    body = Body("ball", particles=(Particle(centre),), velocity=velocity, angular_velocity=spin)
    return on_ground(body, 1.0, [centre], ground, Clock(steps=steps), gravity)


def crate(
    tilt: float = 0.0, height: float = 0.0, ground: Ground = _GROUND, steps: int = 50
) -> Scene:
    """Make a cube with spheres at its corners, turned about z [rad], its bottom at a height [m]."""
    corners = np.array(list(product((-0.2, 0.2), repeat=3)))
    turn = (float(np.cos(tilt / 2)), 0.0, 0.0, float(np.sin(tilt / 2)))
    middle = (0.0, 0.0, height + 0.2 + RADIUS)
    placed = np.array(middle) + rotation.rotate(np.array(turn), corners)
    inertia = Inertia(30.0, (1.5, 1.5, 1.5))
    body = Body("crate", inertia=inertia, position=middle, orientation=turn)
    return on_ground(body, 0.4, placed.tolist(), ground, Clock(steps=steps))


def gaps(scene: Scene, motion: Trajectory) -> Array:
    """Return the heights of the spheres' lowest points [m], shape (trajectory, frame, sphere)."""
    mechanism = Mechanism.of(scene)
    return spheres_of(mechanism, BodyStates.of(mechanism, motion)).gap


def rolling() -> ContactCase:
    """Make a case of balls that slide until they roll: every direction; top, back and side spin.

    The slip v − ω × R ẑ of a ball with velocity v and spin ω keeps its direction n. Friction
    −μ m g n reduces it by (7/2) μ g per second, along a parabola; then the ball rolls straight on.
    """
    scene = ball()
    velocity, spin = _rolling_starts()
    slip = velocity + np.cross(spin, [0.0, 0.0, -RADIUS])
    size = np.linalg.norm(slip, axis=-1, keepdims=True)
    way = np.divide(slip, size, out=np.zeros_like(slip), where=size > 1e-12)
    time = _frames(scene)
    end = size[:, None] / (3.5 * FRICTION * _G)
    sliding = np.minimum(time[:, None], end)
    decay, growth = FRICTION * _G * way, 2.5 * FRICTION * _G / RADIUS * np.cross([0, 0, 1.0], way)
    exact = Trajectory.empty(time, len(velocity), 1)
    exact.velocity[:, :, 0] = velocity[:, None] - decay[:, None] * sliding
    exact.angular_velocity[:, :, 0] = spin[:, None] + growth[:, None] * sliding
    exact.position[:, :, 0] = (
        np.array([0.0, 0.0, RADIUS])
        + velocity[:, None] * sliding
        - 0.5 * decay[:, None] * sliding**2
        + exact.velocity[:, :, 0] * (time[:, None] - sliding)
    )
    return ContactCase(
        "friction alike in every direction, the end of sliding, no friction in rolling",
        scene,
        _started(scene, velocity=velocity[:, None], angular_velocity=spin[:, None]),
        exact,
        drift=FRICTION * _G * np.minimum(time, end.max()),
        creep=np.full(len(time), 1e-3),
    )


def sliding_crate() -> ContactCase:
    """Make a case of a pushed crate that slides v² / (2 μ g) far, and does not turn."""
    scene, speed = crate(ground=Ground(FRICTION, 0.0)), 2.0
    along = np.array([[np.cos(heading), np.sin(heading), 0.0] for heading in _HEADINGS])
    time = _frames(scene)
    sliding = np.minimum(time, speed / (FRICTION * _G))
    batch = _started(scene, velocity=speed * along[:, None])
    exact = _standing(batch, time)
    way = speed * sliding - 0.5 * FRICTION * _G * sliding**2
    exact.position[:, :, 0] += way[:, None] * along[:, None]
    exact.velocity[:, :, 0] = (speed - FRICTION * _G * sliding)[:, None] * along[:, None]
    return ContactCase(
        "friction that ends in rest, on several points",
        scene,
        batch,
        exact,
        drift=FRICTION * _G * sliding,
        creep=np.full(len(time), 1e-3),
    )


def at_rest(scene: Scene) -> ContactCase:
    """Make a case of a scene at rest on the ground, which stays where it is."""
    batch = draw_batch(scene, [0], noise=False)
    time = _frames(scene)
    none = np.zeros(len(time))
    return ContactCase("rest", scene, batch, _standing(batch, time), drift=none, creep=none)


def laid_cubli(steps: int = 50) -> Scene:
    """Place the scene simplecubli with four corners on the ground, and its flywheels at rest."""
    cubli = load_scene("simplecubli")
    assert cubli.contacts
    down = min(sphere.center[2] - sphere.radius for sphere in cubli.contacts)

    def lowered(point: Vector) -> Vector:
        return (point[0], point[1], point[2] - down)

    replaced = msgspec.structs.replace
    bodies = (
        replaced(
            body,
            particles=tuple(replaced(p, position=lowered(p.position)) for p in body.particles),
        )
        for body in cubli.bodies
    )
    return replaced(
        cubli,
        bodies=tuple(bodies),
        joints=tuple(replaced(joint, anchor=lowered(joint.anchor)) for joint in cubli.joints),
        contacts=tuple(replaced(s, center=lowered(s.center)) for s in cubli.contacts),
        sampling=(),
        noise=0.0,
        clock=Clock(steps=steps),
    )


def rebound_heights(scene: Scene, time: Array) -> tuple[Array, Array]:
    """Return the number of bounces before each time, and the height they let the ball reach [m].

    From a height H the fall lasts √(2 H / g), and the k-th flight 2 eᵏ √(2 H / g), up to e²ᵏ H.
    For e < 1 a bounce is counted only if the flight before it rises for at least 1 ms.
    """
    assert scene.ground is not None
    e, height = scene.ground.restitution, float(scene.contacts[0].center[2]) - RADIUS
    fall = np.sqrt(2 * height / _G)
    most = 1000 if e == 1.0 else int(np.log(1e-3 / fall) / np.log(max(e, 1e-9))) + 1
    impacts = fall * (1 + 2 * np.cumsum([0.0, *e ** np.arange(1.0, most)]))
    number = np.searchsorted(impacts, time, side="right")
    return number.astype(np.float64), np.asarray(height * e ** (2.0 * number))


def driven_car() -> ContactCase:
    """Make a case of the car with front wheels spinning, rear ones braked, and changing torques."""
    scene = msgspec.structs.replace(load_scene("particlecar"), clock=Clock(steps=60))
    torque = np.repeat(np.random.default_rng(0).uniform(-2.0, 2.0, (6, 2)), 10, axis=0)
    batch, exact = straight_run(scene, speed=5.0, rates=(40.0, 15.0), torque=torque)
    # The loads of left and right wheels have no unique answer, and turn the car a little.
    exact.position[..., 1] = exact.position[:, :, 1:] = np.nan
    return ContactCase(
        "hinge torques that roll and spin wheels",
        scene,
        batch,
        exact,
        drift=FRICTION * _G * exact.time,
        creep=exact.time,
    )


def _rolling_starts() -> tuple[Array, Array]:
    """Return velocities and spins, shape (row, 3): `_STARTS` in each direction, and two more."""
    rows = []
    for heading, (speed, share) in product(_HEADINGS, _STARTS):
        along = np.array([np.cos(heading), np.sin(heading), 0.0])
        rows.append((speed * along, share * speed / RADIUS * np.cross([0.0, 0.0, 1.0], along)))
    rows.append((np.array([3.0, 0.0, 0.0]), np.array([60.0, 0.0, 30.0])))
    rows.append((np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0 / RADIUS, 40.0])))
    velocity, spin = zip(*rows, strict=True)
    return np.array(velocity), np.array(spin)


def _started(scene: Scene, **start: Any) -> Batch:
    """Start as many rows as the fields have, which replace the scene's own."""
    rows = len(next(iter(start.values())))
    return dataclasses.replace(draw_batch(scene, range(rows), noise=False), **start)


def _frames(scene: Scene) -> Array:
    return scene.clock.frame * np.arange(scene.clock.steps + 1, dtype=np.float64)


def _standing(batch: Batch, time: Array) -> Trajectory:
    exact = Trajectory.empty(time, len(batch), batch.position.shape[1])
    exact.position[:] = batch.position[:, None]
    exact.orientation[:] = batch.orientation[:, None]
    exact.velocity[:] = exact.angular_velocity[:] = 0.0
    return exact


CONTACT_CASES: Mapping[str, Callable[[], ContactCase]] = {
    "slide to roll": rolling,
    "sliding crate": sliding_crate,
    "driven car": driven_car,
    "ball at rest": lambda: at_rest(ball()),
    "crate at rest": lambda: at_rest(crate(tilt=0.4)),
    "cubli at rest": lambda: at_rest(laid_cubli()),
}
"""Makers of the cases that are compared with exact positions frame by frame."""
