"""Checks of single values, each raising a one-line error, and the base class of checked tables."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from typing import (
    Annotated,
    Any,
    ClassVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
import numpy as np

from mbds_xsim.base.errors import SceneError

Check = Callable[[str, Any], None]
"""Function of a key and its value that raises `SceneError` unless the value is allowed."""

_MOST = 10**9
"""Largest count allowed; more frames than this fit into no memory."""
_LARGEST, _SMALLEST, _LEAST_MOMENT = 1e15, 1e-30, 1e-60
_FARTHEST, _SHORTEST = 1e7, 1e-9  # [m]
_LINE = re.compile(r"[^\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufffe\uffff]*")
"""Pattern of a line of text that XML can hold, without control characters."""
_LONGEST_NAME = 200  # bytes; a file name may have 255
_TOO_FAR = "farther out, double precision rounds by more than 1e-9 m"
_TOO_SMALL = "products of smaller numbers underflow"


def rows(key: str, values: tuple[float | tuple[float, ...], ...]) -> None:
    """Raise unless a series has at least one row and all its numbers are finite."""
    _require(bool(values), key, "no row", "is one or more")
    for value in values:
        finite(key, value)


def finite(key: str, values: float | tuple[float, ...]) -> None:
    """Raise unless every number is finite and small enough that products of several stay finite."""
    values = values if isinstance(values, tuple) else (values,)
    for value in values:
        if not math.isfinite(value):
            raise SceneError(f"{key}: got {list(values)}, allowed are finite numbers")
        _at_most(key, value, _LARGEST, "products of larger numbers overflow")


def place(key: str, values: tuple[float, ...]) -> None:
    """Raise unless a point is so near the origin that double precision resolves 1 nm."""
    finite(key, values)
    for value in values:
        _at_most(key, value, _FARTHEST, _TOO_FAR)


def rest_length(key: str, value: float) -> None:
    """Raise unless a length is 0 or more and within the range allowed for points."""
    at_least_zero(key, value)
    place(key, (value,))


def interval(key: str, value: float) -> None:
    """Raise unless the time between frames is long enough for something to move."""
    positive(key, value, least=1e-9, why="in less, 1 m/s moves a body by less than 1e-9 m")


def share(key: str, value: float) -> None:
    """Raise unless a value is in [0, 1]."""
    _require(0.0 <= value <= 1.0, key, value, "is 0 to 1")


def span(key: str, values: tuple[float, float]) -> None:
    """Raise unless two numbers are finite and the first is the smaller one."""
    finite(key, values)
    _require(values[0] < values[1], key, list(values), "are two numbers, the smaller one first")


def size(key: str, value: float) -> None:
    """Raise unless a length is at least 1 nm and within the range allowed for points."""
    positive(key, value, least=_SHORTEST, why="places are resolved to 1e-9 m")
    _at_most(key, value, _FARTHEST, _TOO_FAR)


def positive(key: str, value: float, *, least: float = _SMALLEST, why: str = _TOO_SMALL) -> None:
    """Raise unless a number is finite, above 0 and at least `least`; `why` explains that bound."""
    _require(math.isfinite(value) and value > 0, key, value, "is a finite number above 0")
    if value < least:
        raise SceneError(f"{key}: got {value}, allowed is {least:.0e} or more: {why}")
    finite(key, value)


def at_least_zero(key: str, value: float) -> None:
    """Raise unless a number is finite and 0 or more."""
    _require(math.isfinite(value) and value >= 0, key, value, "is a finite number, 0 or more")
    finite(key, value)


def name(key: str, value: str) -> None:
    """Raise unless a name is a line of text that file names, engines and headings can hold."""
    if not _LINE.fullmatch(value):
        msg = f"{key}: got {value!r}, allowed is a line of text without control characters"
        raise SceneError(msg)
    if (size := len(value.encode("utf-8", "replace"))) > _LONGEST_NAME:
        raise SceneError(
            f"{key}: got {size} bytes of UTF-8, allowed are {_LONGEST_NAME} at most: "
            "files are named after it"
        )


def names(key: str, values: tuple[str, ...]) -> None:
    """Raise unless a list has at least one name and no duplicates."""
    unique = bool(values) and len(set(values)) == len(values)
    _require(unique, key, list(values), "is one name or more, each once")


def count(key: str, got: int, most: int, why: str) -> None:
    """Raise if a number of things exceeds `most`; `why` explains that bound."""
    if got > most:
        raise SceneError(f"{key}: got {got}, allowed are {most} at most: {why}")


def _require(holds: bool, key: str, got: object, allowed: str) -> None:
    if not holds:
        raise SceneError(f"{key}: got {got}, allowed {allowed}")


def _at_most(key: str, value: float, most: float, why: str) -> None:
    if abs(value) > most:
        raise SceneError(f"{key}: got {value}, allowed is {most:.0e} at most: {why}")


def at_least_one(key: str, value: int) -> None:
    """Raise unless a count is 1 or more and at most 1e9."""
    if not 1 <= value <= _MOST:
        allowed = "1 or more" if value < 1 else f"at most {_MOST}"
        raise SceneError(f"{key}: got {value}, allowed is a whole number, {allowed}")


def direction(key: str, value: tuple[float, ...]) -> None:
    """Raise unless a vector is finite and non-zero."""
    if not all(map(math.isfinite, value)):
        finite(key, value)
    _require(math.hypot(*value) > 0, key, list(value), "is any non-zero vector")


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
    if 0 < high < _LEAST_MOMENT:
        raise SceneError(
            f"moments: got {list(moments)}, allowed is {_LEAST_MOMENT:.0e} or more of the largest: "
            f"{_TOO_SMALL}"
        )
    # A vanishing moment leaves the spin about that axis undefined: no engine can step it.
    if not high > 0 or low < 1e-9 * high or low + mid < high * (1 - 1e-9):
        raise SceneError(
            f"moments, products: got principal moments {low:.6g}, {mid:.6g}, {high:.6g}; allowed "
            "is each above 0 and at most the sum of the other two (triangle inequality)"
        )


@dataclass_transform(frozen_default=True, field_specifiers=(msgspec.field,))
class _TakesLists(msgspec.StructMeta):
    """Metaclass that turns lists and arrays into tuples, since scenes are hashed."""

    def __call__(cls, *values: Any, **named: Any) -> Any:
        return super().__call__(
            *map(_hashable, values), **{key: _hashable(value) for key, value in named.items()}
        )


class Neutral(
    msgspec.Struct,
    metaclass=_TakesLists,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
):
    """A frozen table of a scene file; lists and arrays passed to it become tuples.

    Whole numbers in fields of type float become floats, as they do when a file is read. The type of
    a field names its check: `Annotated[float, bounds.positive]`.
    """

    added: ClassVar[tuple[str, ...]] = ()
    """Keys that were added later and whose default is empty. The default is left out of texts and
    fingerprints, so that those of older scenes do not change."""

    def __post_init__(self) -> None:
        """Check every value against the bounds that its type names, and make numbers floats.

        What is right already stays the same object: by that, defaults are left out of texts.
        """
        for key, check in _bounds_of(type(self)):
            check(key, getattr(self, key))
        for key in _float_keys(type(self)):
            value = getattr(self, key)
            if not _has_floats(value):
                msgspec.structs.force_setattr(self, key, _as_floats(value))

    def decisive(self) -> dict[str, Any]:
        """Return all keys and values, without keys in `added` whose value is empty."""
        items = ((key, getattr(self, key)) for key in self.__struct_fields__)
        return {key: value for key, value in items if value or key not in self.added}


@functools.cache
def _bounds_of(table: type[Neutral]) -> tuple[tuple[str, Check], ...]:
    kinds = get_type_hints(table, include_extras=True)
    checks = ((key, _bound(kinds[key])) for key in table.__struct_fields__)
    return tuple((key, check) for key, check in checks if check is not None)


@functools.cache
def _float_keys(table: type[Neutral]) -> tuple[str, ...]:
    """Return the keys of a table whose numbers are all of type float."""
    kinds = get_type_hints(table)
    leaves = {key: _leaves(kinds[key]) for key in table.__struct_fields__}
    return tuple(key for key, found in leaves.items() if float in found and int not in found)


def _leaves(kind: Any) -> set[Any]:
    inner = get_args(kind)
    return set().union(*map(_leaves, inner)) if inner else {kind}


def _has_floats(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_has_floats, value))
    return type(value) is float or not _is_number(value)


def _as_floats(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_as_floats, value))
    return float(value) if _is_number(value) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _bound(kind: Any) -> Check | None:
    """Return the check that a type names for its value or for each of its items; None if none."""
    inner = get_args(kind)
    if get_origin(kind) is Annotated:
        return inner[1]
    item = next((bound for bound in map(_bound, inner) if bound is not None), None)
    if item is None:
        return None
    check = item
    if get_origin(kind) is not tuple:
        return lambda key, value: None if value is None else check(key, value)

    def each(key: str, values: tuple[Any, ...]) -> None:
        for value in values:
            check(key, value)

    return each


def _hashable(value: Any) -> Any:
    plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    return tuple(map(_hashable, plain)) if isinstance(plain, list | tuple) else plain
