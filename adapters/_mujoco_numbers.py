"""Numbers as MJCF has them, with every digit."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["numbers"]


def numbers(values: Iterable[float]) -> str:
    """Write numbers with blanks between them."""
    return " ".join(repr(float(value)) for value in values)
