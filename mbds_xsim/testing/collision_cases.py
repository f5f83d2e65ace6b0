"""Cases of colliding bodies with exact answers: balls in flight, and balls on one frame.

A collision of two homogeneous balls is central. Newton's restitution gives the normal impulse,
Coulomb's friction the tangential one: it stops the slip, or opposes it with μ times the normal one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.collisions import Collisions
from mbds_xsim.scene.scene import (
    GRAVITY,
    Body,
    Clock,
    ContactSphere,
    Ground,
    Inertia,
    Joint,
    Particle,
    Scene,
    Vector,
)
from mbds_xsim.scene.state import Trajectory

RADIUS = 0.05
FRICTION, RESTITUTION = 0.3, 0.8
_STILL = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Flying:
    """A solid sphere that starts in the air."""

    place: Vector
    velocity: Vector = _STILL
    spin: Vector = _STILL
    mass: float = 1.0

    @property
    def moment(self) -> float:
        """Moment of inertia about any axis through its centre [kg·m²]."""
        return 0.4 * self.mass * RADIUS**2


def balls(
    starts: Sequence[Flying],
    friction: float = FRICTION,
    restitution: float = RESTITUTION,
    *,
    ground: Ground | None = None,
    gravity: Vector = _STILL,
    steps: int = 25,
) -> Scene:
    """Make balls, named by their numbers; any two of them may collide."""
    names = [f"ball {k}" for k in range(len(starts))]
    bodies = (
        Body(
            name,
            (Particle(ball.place, ball.mass, ball.moment),),
            velocity=ball.velocity,
            angular_velocity=ball.spin,
        )
        for name, ball in zip(names, starts, strict=True)
    )
    spheres = (ContactSphere(n, ball.place, RADIUS) for n, ball in zip(names, starts, strict=True))
    pairs = tuple((a, b) for k, a in enumerate(names) for b in names[k + 1 :])
    return Scene(
        "balls",
        tuple(bodies),
        length=1.0,
        gravity=gravity,
        contacts=tuple(spheres),
        ground=ground,
        collisions=Collisions(pairs, friction, restitution),
        clock=Clock(steps=steps),
    )


TWO = {
    "head on": (
        Flying((0.0, 0.0, 1.0), (1.5, 0.0, 0.0)),
        Flying((0.43, 0.0, 1.0), (-1.0, 0.0, 0.0)),
    ),
    "slides": (
        Flying((0.0, 0.0, 1.0), (2.0, 0.3, 0.0), (0.0, 0.0, 150.0)),
        Flying((0.4, 0.07, 1.02), mass=2.0),
    ),
    "sticks": (
        Flying((0.0, 0.0, 1.0), (2.0, 0.0, 0.1), (0.0, 8.0, 0.0)),
        Flying((0.4, 0.0, 1.02), (-1.0, 0.0, 0.0), (3.0, 0.0, 2.0), mass=0.5),
    ),
}
"""Pairs of balls that meet centrally, with slip that lasts, and with slip that stops."""


def collided(scene: Scene, starts: Sequence[Flying]) -> tuple[Trajectory, float]:
    """Return the exact motion of two balls without gravity, and the time at which they meet [s].

    Orientations are NaN.
    """
    collisions = scene.collisions
    assert collisions is not None
    place, velocity, spin = (
        np.array([getattr(ball, key) for ball in starts]) for key in ("place", "velocity", "spin")
    )
    mass, moment = (np.array([getattr(ball, key) for ball in starts]) for key in ("mass", "moment"))
    apart, speed = place[0] - place[1], velocity[0] - velocity[1]
    # |apart + speed t| = 2 R
    half, square = float(apart @ speed), float(speed @ speed)
    root = np.sqrt(half**2 - square * (float(apart @ apart) - 4.0 * RADIUS**2))
    touch = (-half - root) / square
    normal = (apart + touch * speed) / (2.0 * RADIUS)
    approach = -float(speed @ normal)
    slip = speed + approach * normal - RADIUS * np.cross(spin.sum(axis=0), normal)
    yields, turns = float(np.sum(1.0 / mass)), float(np.sum(RADIUS**2 / moment))
    push = (1.0 + collisions.restitution) * approach / yields
    size = float(np.linalg.norm(slip))
    drag = min(collisions.friction * push, size / (yields + turns))
    impulse = push * normal - (drag / size * slip if size else 0.0)
    signed = np.array([1.0, -1.0])[:, None] * impulse
    time = scene.clock.frame * np.arange(scene.clock.steps + 1, dtype=np.float64)
    after = (time > touch)[:, None, None]
    motion = Trajectory.empty(time, 1, 2)
    gained = np.where(after, signed / mass[:, None], 0.0)
    motion.velocity[0] = velocity + gained
    since = np.maximum(time - touch, 0.0)[:, None, None]
    motion.position[0] = place + time[:, None, None] * velocity + since * gained
    twist = RADIUS * np.cross(normal, impulse) / moment[:, None]
    motion.angular_velocity[0] = spin - np.where(after, twist, 0.0)
    return motion, float(touch)


_LENGTH = 0.4  # of the pendulums in a cradle, and of a gate [m]
_GATE = ("post", "arm")


def cradle(restitution: float) -> Scene:
    """Hang two equal balls from a fixed frame: one falls from 0.6 rad, one hangs still."""
    top, names = 1.0, ("left", "right")
    places = [(-RADIUS, 0.0, top - _LENGTH), (RADIUS + 1e-9, 0.0, top - _LENGTH)]
    frame = Body("frame", inertia=Inertia(1.0, (0.1, 0.1, 0.1), com=(0.0, 0.0, top)))
    hung = (Body(n, (Particle(at, 1.0, 1e-3),)) for n, at in zip(names, places, strict=True))
    hinges = (
        Joint(n, "hinge", "frame", n, (at[0], 0.0, top), (0.0, -1.0, 0.0), start, 0.0)
        for n, at, start in zip(names, places, (-0.6, 0.0), strict=True)
    )
    return Scene(
        "cradle",
        (frame, *hung),
        length=_LENGTH,
        dimension=2,
        gravity=GRAVITY,
        joints=(Joint("base", "fixed", "world", "frame", (0.0, 0.0, top)), *hinges),
        contacts=tuple(ContactSphere(n, at, RADIUS) for n, at in zip(names, places, strict=True)),
        collisions=Collisions((names,), 0.0, restitution),
        clock=Clock(frame=0.01, steps=60),
    )


def gate(restitution: float) -> Scene:
    """Hinge an arm with a ball upright on a fixed post; it swings against the post's own ball."""
    away = 0.8  # [rad]
    places = [(_LENGTH, 0.0, 0.0), (_LENGTH * math.cos(away), -_LENGTH * math.sin(away), 0.0)]
    still = Joint("still", "fixed", "world", "post", (0.0, 0.0, 0.0))
    hinge = Joint("hinge", "hinge", "post", "arm", (0.0,) * 3, (0.0, 0.0, 1.0), 0.0, 3.0)
    return Scene(
        "gate",
        tuple(Body(n, (Particle(p, 1.0, 1e-3),)) for n, p in zip(_GATE, places, strict=True)),
        length=_LENGTH,
        gravity=(0.0, 0.0, 0.0),
        joints=(still, hinge),
        contacts=tuple(ContactSphere(n, p, RADIUS) for n, p in zip(_GATE, places, strict=True)),
        collisions=Collisions((_GATE,), 0.0, restitution),
        clock=Clock(frame=0.01, steps=40),
    )


def swings(scene: Scene, motion: Trajectory) -> Array:
    """Return how high each ball's energy would let it swing [m], shape (frame, ball)."""
    place, speed, spin = (
        values[0, :, 1:] for values in (motion.position, motion.velocity, motion.angular_velocity)
    )
    low = min(sphere.center[2] for sphere in scene.contacts)
    turning = 1e-3 * np.sum(spin**2, axis=-1)
    kinetic = 0.5 * (np.sum(speed**2, axis=-1) + turning)
    return np.asarray(place[..., 2] - low + kinetic / -GRAVITY[2])
