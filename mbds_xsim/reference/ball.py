"""Motion on the ground of a free body with one contact sphere around its centre of mass.

The ground acts at the point vertically below the centre of mass, so normal and tangential motion do
not couple: the normal force is that of a mass point, the normal and tangential parts of an impact
are independent, and no moment acts about the vertical.

Vectors in the ground plane are complex numbers x + iy; z × v is then i·v.

Under a constant drive and Coulomb friction the slip obeys s' = a − b s/|s|. The drive a is the
acceleration of the slip by the loads alone, the brake b its deceleration by friction. In the scaled
time σ with dt = |s| dσ this is linear, ds/dσ = a|s| − b s and d|s|/dσ = a·s − b|s|; with ∥ and ⊥
relative to the drive,

    |s| ± s∥ ∝ exp(−(b ∓ |a|) σ)    and    s⊥ ∝ exp(−b σ),

so that t(σ) and ∫ s dt are sums of exponentials too.

Friction changes the spin of an *even* ball equally in every direction that occurs: the ball has
three equal moments of inertia, or moves in the x–z plane, where only the moment about y counts.
Its motion has a closed form, except for the orientation while the axis of rotation turns.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.turning import turned

STILL = 1e-12
"""Speed below which a slip counts as zero [m/s]; rounding leaves 1e-15."""


@dataclass(frozen=True, slots=True)
class BallState:
    """State of a ball."""

    place: complex
    """Horizontal position of the centre of mass [m]."""
    gap: float
    """Gap between the sphere and the ground; exactly 0 in contact [m]."""
    velocity: complex
    climb: float
    """Vertical velocity; exactly 0 in sustained contact [m/s]."""
    spin: complex
    """Horizontal part of the angular velocity [rad/s]."""
    twist: float
    """Vertical part of the angular velocity [rad/s]."""
    turn: Array
    """Rotation from the principal frame to W, shape (4,)."""


@dataclass(frozen=True, slots=True)
class Load:
    """Acceleration that gravity and held forces give the centre of mass [m/s²]."""

    push: complex
    lift: float
    """Upward part; the ground carries mass times its negative."""


@dataclass(frozen=True, slots=True)
class BallContact:
    """Parameters of the contact with the ground."""

    mass: float
    radius: float
    friction: float
    restitution: float

    def slip(self, motion: BallState) -> complex:
        """Velocity of the sphere's lowest point."""
        return motion.velocity + 1j * self.radius * motion.spin

    def impulse(self, motion: BallState) -> float:
        """Impulse of the normal reaction in an impact, by Newton's law."""
        return self.mass * (1.0 + self.restitution) * -motion.climb

    def rebound(self, motion: BallState) -> float:
        """Vertical velocity after an impact."""
        return -self.restitution * motion.climb


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
    """Time until the sphere comes down to the ground [s]; infinite if it never does."""
    square = motion.climb**2 - 2.0 * load.lift * motion.gap
    if square < 0.0 or (motion.climb >= 0.0 and load.lift >= 0.0):
        return math.inf
    # Of the two forms of the root, take the one without cancellation.
    if motion.climb < 0.0:
        return max(0.0, 2.0 * motion.gap / (math.sqrt(square) - motion.climb))
    return (motion.climb + math.sqrt(square)) / -load.lift


# Share of the slip across the drive below which the path is straight to rounding.
_STRAIGHT = 1e-15


class Sliding(NamedTuple):
    """A stretch of sliding."""

    duration: float
    """Duration [s]."""
    slip: complex
    """Slip at the end; 0 if friction has stopped it [m/s]."""
    travelled: complex
    """∫ s dt [m]."""


def slide(slip: complex, drive: complex, brake: float, limit: float) -> Sliding:
    """Slide until the slip stops, but no longer than a limit.

    A slip of zero starts along the drive, which must then be stronger than the brake.

    Args:
        slip: Slip at the start [m/s].
        drive: Drive a [m/s²].
        brake: Brake b, not negative [m/s²].
        limit: Longest duration [s].
    """
    across = (slip * drive.conjugate()).imag
    if abs(across) <= _STRAIGHT * abs(slip) * abs(drive):
        return _straight(slip, drive, brake, limit)
    return _curved(slip, drive, brake, limit)


def _straight(slip: complex, drive: complex, brake: float, limit: float) -> Sliding:
    speed = abs(slip)
    ahead = slip / speed if speed else drive / abs(drive)
    slowing = brake - (drive * ahead.conjugate()).real
    stops = slowing > 0.0 and speed <= slowing * limit
    t = min(speed / slowing, limit) if stops else limit
    end = 0.0 if stops else speed - slowing * t
    return Sliding(t, end * ahead, t * (speed - 0.5 * slowing * t) * ahead)


def _curved(slip: complex, drive: complex, brake: float, limit: float) -> Sliding:
    a, b, unit = abs(drive), brake, drive / abs(drive)
    relative = slip * unit.conjugate()
    # P and Q are (|s| ± s∥)/2, the smaller one without cancellation.
    large = 0.5 * (abs(slip) + abs(relative.real))
    small = relative.imag**2 / (4.0 * large)
    p, q = (large, small) if relative.real >= 0.0 else (small, large)

    def time(stretched: float) -> float:
        return p * _decayed(b - a, stretched) + q * _decayed(b + a, stretched)

    stopped = b > a and time(math.inf) <= limit
    end = math.inf if stopped else _reach(time, limit, 1.0 / (a + b))
    travelled = complex(
        p * p * _decayed(2 * (b - a), end) - q * q * _decayed(2 * (b + a), end),
        relative.imag * (p * _decayed(2 * b - a, end) + q * _decayed(2 * b + a, end)),
    )
    remaining = complex(
        p * math.exp(-(b - a) * end) - q * math.exp(-(b + a) * end),
        relative.imag * math.exp(-b * end),
    )
    duration = time(end) if stopped else limit
    return Sliding(duration, 0j if stopped else unit * remaining, unit * travelled)


def _decayed(rate: float, stretched: float) -> float:
    """∫ exp(−rate σ) dσ from 0."""
    return -math.expm1(-rate * stretched) / rate if rate else stretched


def _reach(time: Callable[[float], float], limit: float, guess: float) -> float:
    """Find the σ at which the increasing time(σ) reaches the limit."""
    from scipy.optimize import brentq  # takes long to import

    high = guess
    while time(high) < limit:
        high *= 2.0
    return float(brentq(lambda x: time(x) - limit, 0.0, high, xtol=1e-300, rtol=1e-15))


_Law = Callable[[float], Sliding]


@dataclass(frozen=True, slots=True)
class EvenBall:
    """Laws of motion of an even ball."""

    contact: BallContact
    inertia: float
    """Moment of inertia [kg·m²]."""

    @property
    def yielding(self) -> float:
        """Slip that a unit tangential impulse gives the lowest point [1/kg]."""
        return 1.0 / self.contact.mass + self.contact.radius**2 / self.inertia

    def fly(self, motion: BallState, load: Load, duration: float) -> BallState:
        """Move without contact: a parabola, at a constant spin."""
        turn = _turned_by(motion.turn, motion.spin * duration, motion.twist * duration)
        return dataclasses.replace(flown(motion, load, duration), turn=turn)

    def hit(self, motion: BallState) -> BallState:
        """Bounce: friction removes all slip, or as much as μ times the normal impulse can."""
        slip, most = self.contact.slip(motion), self.contact.friction * self.contact.impulse(motion)
        stick = abs(slip) <= most * self.yielding
        braked = slip if stick else most * self.yielding * slip / abs(slip)
        return dataclasses.replace(self._braked(motion, braked), climb=self.contact.rebound(motion))

    def keep_contact(self, motion: BallState, load: Load, limit: float) -> tuple[float, BallState]:
        """Slide until the slip stops, or roll while friction can hold against the loads."""
        slip = self.contact.slip(motion)
        brake = self.contact.friction * self.contact.mass * -load.lift * self.yielding
        if abs(slip) <= STILL:
            slip = 0j
        if slip or abs(load.push) > brake:
            law: _Law = functools.partial(slide, slip, load.push, brake)
        else:
            law = _no_slide
        part = law(limit)
        return part.duration, self._carried(motion, load, slip, part, law)

    def _carried(
        self, motion: BallState, load: Load, slip: complex, part: Sliding, law: _Law
    ) -> BallState:
        """Follow the centre of mass and the spin along a known slip."""
        t = part.duration
        lost = t * (slip + 0.5 * t * load.push) - part.travelled
        moved = flown(motion, Load(load.push, 0.0), t)
        moved = self._braked(moved, slip + t * load.push - part.slip)
        place = moved.place - lost / (self.contact.mass * self.yielding)

        def spin(at: float) -> complex:
            return motion.spin + self._lever() * (slip + at * load.push - law(at).slip)

        turn = _rolled(motion, spin, self._lever() * lost, t)
        return dataclasses.replace(moved, place=place, turn=turn)

    def _braked(self, motion: BallState, slip: complex) -> BallState:
        """Remove some slip by a tangential impulse."""
        share = self.contact.mass * self.yielding
        return dataclasses.replace(
            motion, velocity=motion.velocity - slip / share, spin=motion.spin + self._lever() * slip
        )

    def _lever(self) -> complex:
        return 1j * self.contact.radius / (self.inertia * self.yielding)


def _no_slide(limit: float) -> Sliding:
    return Sliding(limit, 0j, 0j)


def _rolled(
    motion: BallState, spin: Callable[[float], complex], gained: complex, t: float
) -> Array:
    """Turn by a spin whose integral is known, which is enough if its axis keeps its direction."""
    if not gained or (motion.twist == 0.0 and (motion.spin * gained.conjugate()).imag == 0.0):
        return _turned_by(motion.turn, motion.spin * t + gained, motion.twist * t)
    return turned(motion.turn, lambda at: _vector(spin(at), motion.twist), t)


def _turned_by(turn: Array, angle: complex, twist: float) -> Array:
    return rotation.multiply(rotation.from_vector(_vector(angle, twist)), turn)


def _vector(plane: complex, up: float) -> Array:
    return np.array([plane.real, plane.imag, up])
