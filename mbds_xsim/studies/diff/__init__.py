"""Stored results in a common form, in which two of them can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Value = float | int | bool | str | None

FAILING = 2
"""Lowest rank of a verdict that is a failure."""


@dataclass(frozen=True)
class PhysicalFigure:
    """A figure of physics; its value is None if there is none."""

    value: float | None
    unit: str = "1"
    scale: float = 0.0
    """Budget in the same unit: differences far below it are no changes; 0 if there is none."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A part of a result with figures of its own: an engine, a curve or a point of it, a cell."""

    verdict: str
    rank: int | None
    """0 is best, `FAILING` and more are failures. None: neither better nor worse than another."""
    parent: str = ""
    """Name of the entry that this one is a part of."""
    settings: Mapping[str, Value] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    broken: frozenset[str] = frozenset()
    """Checks that exceed their budgets."""
    judged: frozenset[str] | None = frozenset()
    """Checks that have a budget; None: all checks."""
    figures: Mapping[str, PhysicalFigure] = field(default_factory=dict)
    timings: Mapping[str, float | None] = field(default_factory=dict)
    """Times [s], and other figures that the machine decides."""

    def keeps(self, check: str) -> bool:
        """Return whether a check was judged and kept its budget."""
        return check not in self.broken and (self.judged is None or check in self.judged)


@dataclass(frozen=True, kw_only=True)
class View:
    """The result of one scene."""

    scene: str
    """Name of the scene; for a study of stability, the name of the study."""
    command: str
    identity: Mapping[str, Value] = field(default_factory=dict)
    """Properties that are equal if the scene is the same; a value is None if unknown."""
    sample: Mapping[str, Value] = field(default_factory=dict)
    """Sample and how it was judged: seed, starts, budgets."""
    circumstances: Mapping[str, Value]
    """Versions and machine."""
    entries: Mapping[str, Entry]
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Engines or methods that were left out, each with the reason."""
