"""Progress that nobody watches."""

from __future__ import annotations


class Silent:
    """Progress sink that discards everything."""

    def begin(self, total: int, done: int = 0) -> None:
        """Discard how much there is."""

    def advance(self, what: object, rejected: int = 0) -> None:
        """Discard what is done."""

    def doing(self, what: str) -> None:
        """Discard what is under way."""

    def notice(self, line: str) -> None:
        """Discard what was to be read."""

    def forecast(self, left_s: float) -> None:
        """Discard how long it will take."""
