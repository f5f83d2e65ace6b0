"""Who is told how far a study is."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Meter"]


class Meter(Protocol):
    """A bar: it begins anew for each kind of work."""

    def begin(self, total: int) -> None:
        """Say how many pieces of work there are."""

    def advance(self, what: str) -> None:
        """Tell of one that is done."""
