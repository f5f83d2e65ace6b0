"""A free body with one contact sphere around its centre of mass, and how it moves on the ground.

The ground's reaction has its arm along the vertical, so normal and tangential motion do not mix:
the normal force is that of a mass point, impacts have a normal and a tangential part of their own,
and there is nothing that could turn the body about the vertical.

Vectors of the ground plane are complex numbers x + iy; z × v is then i·v.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Protocol

from mbds_xsim.base.arrays import Array

STILL = 1e-12
"""Slip below which there is none [m/s]; rounding leaves 1e-15."""


@dataclass(frozen=True, slots=True)
class BallState:
    """State of the body."""

    place: complex
    """Of the centre of mass over the ground [m]."""
    gap: float
    """Between the sphere and the ground; exactly 0 in contact [m]."""
    velocity: complex
    climb: float
    """Vertical velocity; exactly 0 in sustained contact [m/s]."""
    spin: complex
    """Horizontal part of the angular velocity [rad/s]."""
    twist: float
    """Vertical part of the angular velocity [rad/s]."""
    turn: Array
    """Principal frame to W, shape (4,)."""


@dataclass(frozen=True, slots=True)
class Load:
    """Acceleration that gravity and held forces give the centre of mass [m/s²]."""

    push: complex
    lift: float
    """Upward; the ground carries mass times its negative."""


@dataclass(frozen=True, slots=True)
class BallContact:
    """What the contact with the ground is made of."""

    mass: float
    radius: float
    friction: float
    restitution: float

    def slip(self, motion: BallState) -> complex:
        """Velocity of the sphere's lowest point."""
        return motion.velocity + 1j * self.radius * motion.spin

    def impulse(self, motion: BallState) -> float:
        """Of the normal reaction in an impact, by Newton's law."""
        return self.mass * (1.0 + self.restitution) * -motion.climb

    def rebound(self, motion: BallState) -> float:
        """Vertical velocity after an impact."""
        return -self.restitution * motion.climb


class Ball(Protocol):
    """The laws of motion of one body."""

    @property
    def contact(self) -> BallContact:
        """What it touches the ground with."""
        ...

    def fly(self, motion: BallState, load: Load, duration: float) -> BallState:
        """Move without contact."""
        ...

    def hit(self, motion: BallState) -> BallState:
        """Bounce off the ground."""
        ...

    def keep_contact(self, motion: BallState, load: Load, limit: float) -> tuple[float, BallState]:
        """Slide or roll on the ground up to a change of the two, or a limit; also gives when."""
        ...


def flown(motion: BallState, load: Load, t: float) -> BallState:
    """Move the centre of mass along its parabola; the rotation is left as it is."""
    return dataclasses.replace(
        motion,
        place=motion.place + t * (motion.velocity + 0.5 * t * load.push),
        gap=motion.gap + t * (motion.climb + 0.5 * t * load.lift),
        velocity=motion.velocity + t * load.push,
        climb=motion.climb + t * load.lift,
    )


def time_to_ground(motion: BallState, load: Load) -> float:
    """When the sphere comes down to the ground; infinite where it never does."""
    square = motion.climb**2 - 2.0 * load.lift * motion.gap
    if square < 0.0 or (motion.climb >= 0.0 and load.lift >= 0.0):
        return math.inf
    # Of the root's two forms the one without cancellation.
    if motion.climb < 0.0:
        return max(0.0, 2.0 * motion.gap / (math.sqrt(square) - motion.climb))
    return (motion.climb + math.sqrt(square)) / -load.lift
