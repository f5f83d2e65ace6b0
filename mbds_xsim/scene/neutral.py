"""The base class of everything that a scene is made of."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Annotated, Any, dataclass_transform, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

Check = Callable[[str, Any], None]
"""Raises unless a value, under its key, is allowed."""


@dataclass_transform(frozen_default=True, field_specifiers=(msgspec.field,))
class _TakesLists(msgspec.StructMeta):
    """Lets values be given as lists or arrays: a scene is hashed, so it holds tuples."""

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
    """A frozen table of a scene file; lists and arrays that it is given become tuples.

    Fields say in their types what they allow: `Annotated[float, bounds.positive]`.
    """

    def __post_init__(self) -> None:
        """Hold every value against the bounds that its type names."""
        for key, check in _bounds_of(type(self)):
            check(key, getattr(self, key))


@functools.cache
def _bounds_of(table: type[Neutral]) -> tuple[tuple[str, Check], ...]:
    kinds = get_type_hints(table, include_extras=True)
    found = ((key, _bound(kinds[key])) for key in table.__struct_fields__)
    return tuple((key, check) for key, check in found if check is not None)


def _bound(kind: Any) -> Check | None:
    """Bound that a type names, of the value itself or of each of its items; None: none."""
    inner = get_args(kind)
    if get_origin(kind) is Annotated:
        return inner[1]
    item = next((found for found in map(_bound, inner) if found is not None), None)
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
