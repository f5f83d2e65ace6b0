"""Places in nested tables, which scene files are read as."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable
from typing import Any

Place = tuple[Any, ...]


def at(table: Any, place: Iterable[Any]) -> Any:
    return functools.reduce(operator.getitem, place, table)


def places(value: Any, place: Place = ()) -> list[Place]:
    """List the place of a value and those of all values in it."""
    if not isinstance(value, dict | list):
        return [place]
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return [place, *(leaf for key, item in items for leaf in places(item, (*place, key)))]
