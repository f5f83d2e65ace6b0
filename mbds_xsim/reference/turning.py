"""Integration of orientations and other small systems to about 1e-13."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array

_RTOL = {"DOP853": 1e-13, "LSODA": 1e-12}


def turned(turn: Array, rate: Callable[[float], Array], duration: float) -> Array:
    """Turn a quaternion by an angular velocity that is a known function of time.

    Args:
        turn: Quaternion at the start, shape (4,).
        rate: Angular velocity in W [rad/s], shape (3,), as a function of the time since the start.
        duration: Duration [s].
    """
    end = integrated(lambda t, q: turning(q, rate(t)), turn, duration).y[:, -1]
    return np.asarray(end / np.linalg.norm(end))


def turning(turn: Array, spin: Array) -> Array:
    """Return the rate of a quaternion under an angular velocity in W."""
    vector = turn[1:]
    return 0.5 * np.append(-spin @ vector, spin * turn[0] + cross(spin, vector))


def cross(a: Array, b: Array) -> Array:
    """Cross product; ten times faster than numpy's on single vectors."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def integrated(
    rate: Callable[[float, Array], Array],
    start: Array,
    duration: float,
    *ends: Callable[[float, Array], float],
    method: str = "DOP853",
) -> Any:
    """Integrate up to a time, or until one of `ends` falls to zero; return as `solve_ivp` does.

    Raises:
        ArithmeticError: The integration fails.
    """
    from scipy.integrate import solve_ivp  # takes long to import

    for end in ends:
        end.terminal, end.direction = True, -1.0  # type: ignore[attr-defined]
    rtol = _RTOL[method]
    span = (0.0, duration)
    result = solve_ivp(
        rate, span, start, method=method, rtol=rtol, atol=0.1 * rtol, events=ends or None
    )
    if not result.success:
        raise ArithmeticError(result.message)
    return result
