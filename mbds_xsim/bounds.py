"""Checks of single values, each raising one line: what was got, what is allowed."""

from __future__ import annotations

import math

import numpy as np

from mbds_xsim.errors import SceneError

_MOST = 10**9
"""More frames than this fit into no memory."""
_LARGEST, _SMALLEST, _LEAST_MOMENT = 1e15, 1e-30, 1e-60
_FARTHEST, _SHORTEST = 1e7, 1e-9  # [m]
_LONGEST_NAME = 200


def held_series(length: int, hold: int) -> None:
    """Raise unless a held series has rows and lasts."""
    at_least_one("hold", hold)
    if length < 1:
        msg = "series: got no row, allowed is one or more"
        raise SceneError(msg)


def finite(key: str, values: tuple[float, ...]) -> None:
    """Raise unless every number is finite, and small enough to be squared and added up."""
    for value in values:
        if not math.isfinite(value):
            msg = f"{key}: got {list(values)}, allowed are finite numbers"
            raise SceneError(msg)
        _at_most(key, value, _LARGEST, "products of larger ones are no numbers any more")


def place(key: str, values: tuple[float, ...]) -> None:
    """Raise unless a point is where numbers still tell 1 nm apart."""
    finite(key, values)
    for value in values:
        _at_most(key, value, _FARTHEST, "farther out doubles lie more than 1e-9 m apart")


def size(key: str, value: float) -> None:
    """Raise unless a length can be that of a body, above 0."""
    positive(key, value, least=_SHORTEST)
    _at_most(key, value, _FARTHEST, "farther out doubles lie more than 1e-9 m apart")


def positive(key: str, value: float, *, least: float = _SMALLEST) -> None:
    """Raise unless finite and above 0, by so much that it can be squared and divided by."""
    if not (math.isfinite(value) and value > 0):
        msg = f"{key}: got {value}, allowed is a finite number above 0"
        raise SceneError(msg)
    if value < least:
        msg = f"{key}: got {value}, allowed is {least:.0e} or more: less is lost in rounding errors"
        raise SceneError(msg)
    finite(key, (value,))


def at_least_zero(key: str, value: float) -> None:
    """Raise unless finite and not below 0."""
    if not (math.isfinite(value) and value >= 0):
        msg = f"{key}: got {value}, allowed is a finite number, 0 or more"
        raise SceneError(msg)
    finite(key, (value,))


def name(value: str) -> None:
    """Raise unless a name is text that files, engines and terminals can hold."""
    if not value.isprintable():
        msg = f"name: got {value!r}, allowed are characters that can be printed"
        raise SceneError(msg)
    if len(value) > _LONGEST_NAME:
        msg = f"name: got {len(value)} characters, allowed are {_LONGEST_NAME}: it names files"
        raise SceneError(msg)


def count(key: str, got: int, most: int, why: str) -> None:
    """Raise unless there are few enough of something."""
    if got > most:
        msg = f"{key}: got {got}, allowed are {most} at most: {why}"
        raise SceneError(msg)


def _at_most(key: str, value: float, most: float, why: str) -> None:
    if abs(value) > most:
        msg = f"{key}: got {value}, allowed is {most:.0e} at most: {why}"
        raise SceneError(msg)


def at_least_one(key: str, value: int) -> None:
    """Raise unless 1 or more, and few enough to count."""
    if not 1 <= value <= _MOST:
        allowed = "1 or more" if value < 1 else f"at most {_MOST}"
        msg = f"{key}: got {value}, allowed is a whole number, {allowed}"
        raise SceneError(msg)


def direction(key: str, value: tuple[float, ...]) -> None:
    """Raise unless a vector points somewhere."""
    if not all(map(math.isfinite, value)):
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
    if not _LEAST_MOMENT < high < _LARGEST:
        msg = (
            f"moments: got {list(moments)}, allowed are {_LEAST_MOMENT:.0e} to {_LARGEST:.0e}: "
            "others are lost in rounding errors"
        )
        raise SceneError(msg)
    # A vanishing moment leaves the spin about that axis undefined: no engine can step it.
    if not high > 0 or low < 1e-9 * high or low + mid < high * (1 - 1e-9):
        msg = (
            f"moments, products: got principal moments {low:.6g}, {mid:.6g}, {high:.6g}; allowed "
            "is each above 0 and at most the sum of the other two (triangle inequality)"
        )
        raise SceneError(msg)
