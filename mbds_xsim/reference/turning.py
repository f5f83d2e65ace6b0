"""Orientation of a body whose angular velocity is a known function of time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation

Array = NDArray[np.float64]

_NODES = 0.5 + math.sqrt(15.0) / 10.0 * np.array([-1.0, 0.0, 1.0])
_ACCURATE = 1e-13
_FIRST_PARTS, _MOST_PARTS = 2, 1 << 12
_GAIN = 2.0**6


def turned(turn: Array, rate: Callable[[float], Array], duration: float) -> Array:
    """Turn a quaternion by an angular velocity in W, to some 1e-13.

    Magnus's series of order 6 over parts that are halved until the change tells that they are
    short enough; Blanes, Casas, Ros, "Improved high order integrators based on the Magnus
    expansion", BIT 40 (2000), 434.

    Args:
        turn: At the start, shape (4,).
        rate: Angular velocity in W at a time from the start [rad/s], shape (3,).
        duration: [s].
    """
    parts = _FIRST_PARTS
    before = _in_parts(rate, duration, parts)
    while True:
        parts *= 2
        after = _in_parts(rate, duration, parts)
        if parts >= _MOST_PARTS or np.abs(after - before).max() <= _ACCURATE * _GAIN:
            return rotation.multiply(after, turn)
        before = after


def _in_parts(rate: Callable[[float], Array], duration: float, parts: int) -> Array:
    h = duration / parts
    at = h * (np.arange(parts)[:, None] + _NODES)
    rates = np.array([rate(float(t)) for t in at.reshape(-1)]).reshape(parts, 3, 3)
    turns = rotation.from_vector(_magnus(h, *np.moveaxis(rates, 1, 0)))
    while len(turns) > 1:
        turns = rotation.multiply(turns[1::2], turns[::2])
    return np.asarray(turns[0])


def _magnus(h: float, first: Array, middle: Array, last: Array) -> Array:
    a = h * middle
    b = math.sqrt(15.0) / 3.0 * h * (last - first)
    c = 10.0 / 3.0 * h * (last - 2.0 * middle + first)
    ab = np.cross(a, b)
    bent = b - np.cross(a, 2.0 * c + ab) / 60.0
    return np.asarray(a + c / 12.0 + np.cross(-20.0 * a - c + ab, bent) / 240.0)
