"""Checks of single values, each raising one line: what was got, what is allowed."""

from __future__ import annotations

import math

import numpy as np

from mbds_xsim.errors import SceneError

_MOST = 10**9
"""More frames than this fit into no memory."""


def held_series(length: int, hold: int) -> None:
    """Raise unless a held series has rows and lasts."""
    at_least_one("hold", hold)
    if length < 1:
        msg = "series: got no row, allowed is one or more"
        raise SceneError(msg)


def finite(key: str, values: tuple[float, ...]) -> None:
    """Raise unless every number is finite."""
    if not all(math.isfinite(value) for value in values):
        msg = f"{key}: got {list(values)}, allowed are finite numbers"
        raise SceneError(msg)


def positive(key: str, value: float) -> None:
    """Raise unless finite and above 0."""
    if not (math.isfinite(value) and value > 0):
        msg = f"{key}: got {value}, allowed is a finite number above 0"
        raise SceneError(msg)


def at_least_zero(key: str, value: float) -> None:
    """Raise unless finite and not below 0."""
    if not (math.isfinite(value) and value >= 0):
        msg = f"{key}: got {value}, allowed is a finite number, 0 or more"
        raise SceneError(msg)


def at_least_one(key: str, value: int) -> None:
    """Raise unless 1 or more, and few enough to count."""
    if not 1 <= value <= _MOST:
        allowed = "1 or more" if value < 1 else f"at most {_MOST}"
        msg = f"{key}: got {value}, allowed is a whole number, {allowed}"
        raise SceneError(msg)


def direction(key: str, value: tuple[float, ...]) -> None:
    """Raise unless a vector points somewhere."""
    finite(key, value)
    if not math.hypot(*value) > 0:
        msg = f"{key}: got {list(value)}, allowed is any non-zero vector"
        raise SceneError(msg)


def unit(key: str, value: tuple[float, ...]) -> None:
    """Raise unless a quaternion has norm 1."""
    finite(key, value)
    if abs(math.hypot(*value) - 1) > 1e-9:
        msg = f"{key}: got {list(value)} of norm {math.hypot(*value):.9g}, allowed is norm 1"
        raise SceneError(msg)


def physical_inertia(
    moments: tuple[float, float, float], products: tuple[float, float, float]
) -> None:
    """Raise unless the principal moments are positive and obey the triangle inequality."""
    (xx, yy, zz), (xy, xz, yz) = moments, products
    low, mid, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # A vanishing moment leaves the spin about that axis undefined: no engine can step it.
    if not high > 0 or low < 1e-9 * high or low + mid < high * (1 - 1e-9):
        msg = (
            f"moments, products: got principal moments {low:.6g}, {mid:.6g}, {high:.6g}; allowed "
            "is each above 0 and at most the sum of the other two (triangle inequality)"
        )
        raise SceneError(msg)
