"""Slip of a contact point under a constant drive and Coulomb friction, in closed form.

Vectors of the plane are complex numbers. The slip obeys s' = a − b s/|s|: the drive a is what the
loads alone would do to it, the brake b what friction does. In the time σ with dt = |s| dσ this is
linear, ds/dσ = a|s| − b s and d|s|/dσ = a·s − b|s|; with ∥ and ⊥ taken from the drive,

    |s| ± s∥ ∝ exp(−(b ∓ |a|) σ)    and    s⊥ ∝ exp(−b σ),

so that t(σ) and ∫ s dt are sums of exponentials too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

# Of the slip, across the drive, below which the path is straight to rounding.
_STRAIGHT = 1e-15


@dataclass(frozen=True, slots=True)
class Sliding:
    """A stretch of sliding."""

    duration: float
    """[s]"""
    slip: complex
    """At the end; 0 where friction has stopped it [m/s]."""
    travelled: complex
    """∫ s dt [m]."""


def slide(slip: complex, drive: complex, brake: float, limit: float) -> Sliding:
    """Slide until the slip stops, and no longer than a limit.

    A slip of zero starts along the drive, which must then be stronger than the brake.

    Args:
        slip: At the start [m/s].
        drive: a [m/s²].
        brake: b, not negative [m/s²].
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
    turned = slip * unit.conjugate()
    # P and Q are (|s| ± s∥)/2, the smaller one without cancellation.
    large = 0.5 * (abs(slip) + abs(turned.real))
    small = turned.imag**2 / (4.0 * large)
    p, q = (large, small) if turned.real >= 0.0 else (small, large)

    def time(stretched: float) -> float:
        return p * _decayed(b - a, stretched) + q * _decayed(b + a, stretched)

    stopped = b > a and time(math.inf) <= limit
    end = math.inf if stopped else _reach(time, limit, 1.0 / (a + b))
    travelled = complex(
        p * p * _decayed(2 * (b - a), end) - q * q * _decayed(2 * (b + a), end),
        turned.imag * (p * _decayed(2 * b - a, end) + q * _decayed(2 * b + a, end)),
    )
    left = complex(
        p * math.exp(-(b - a) * end) - q * math.exp(-(b + a) * end),
        turned.imag * math.exp(-b * end),
    )
    duration = time(end) if stopped else limit
    return Sliding(duration, 0j if stopped else unit * left, unit * travelled)


def _decayed(rate: float, stretched: float) -> float:
    """∫ exp(−rate σ) dσ from 0."""
    return -math.expm1(-rate * stretched) / rate if rate else stretched


def _reach(time: Callable[[float], float], limit: float, guess: float) -> float:
    """Find σ where the increasing time(σ) is the limit."""
    from scipy.optimize import brentq  # takes long to import

    high = guess
    while time(high) < limit:
        high *= 2.0
    return float(brentq(lambda x: time(x) - limit, 0.0, high, xtol=1e-300, rtol=1e-15))
