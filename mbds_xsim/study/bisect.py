"""The fewest steps that are good enough, in few trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

__all__ = ["COUNTS", "Search"]

COUNTS = (
    1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 100, 128, 160, 200, 250, 320,
    400, 500, 640, 800, 1000, 1200, 1600, 2000,
)  # fmt: skip
"""Steps a frame that are tried."""

_STRIDE = 3
"""Counts that are jumped over on the way up: about a doubling."""


@dataclass
class Search:
    """Looks for the first of a rising list that passes, where all later ones pass too."""

    counts: Sequence[int] = COUNTS
    failed: int = -1
    """Place of the largest count that failed."""
    passed: int | None = None
    """Place of the smallest count that passed."""
    closed: bool = field(default=False)
    """Whether larger counts are out of the question."""

    @property
    def next(self) -> int | None:
        """Count to try next; None when the search is over."""
        if self.passed is None:
            if self.closed or self.failed == len(self.counts) - 1:
                return None
            up = self.failed + (_STRIDE if self.failed >= 0 else 1)
            return self.counts[min(up, len(self.counts) - 1)]
        if self.passed - self.failed <= 1:
            return None
        return self.counts[(self.passed + self.failed) // 2]

    @property
    def found(self) -> int | None:
        """The answer, once the search is over."""
        return None if self.passed is None else self.counts[self.passed]

    def tell(self, count: int, passed: bool) -> None:
        """Say how a trial ended."""
        place = self.counts.index(count)
        if passed:
            self.passed = place
        else:
            self.failed = place

    def refuse(self, count: int) -> None:
        """Say, later, that what passed fails after all: the next larger count is the answer."""
        place = self.counts.index(count)
        self.failed = place
        self.passed = place + 1 if place + 1 < len(self.counts) else None
