"""What a stored result says, in a form that two of them can be compared in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Value = float | int | bool | str | None

FAILING = 2
"""Rank from which on a verdict is a failure."""


@dataclass(frozen=True)
class PhysicalFigure:
    """A figure of physics; None: there is none."""

    value: float | None
    unit: str = "1"
    scale: float = 0.0
    """Its budget in its unit, so that a difference far below it is no change; 0: it has none."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """An engine, a curve, a point of a curve, a cell of a map: whatever has figures of its own."""

    verdict: str
    rank: int | None
    """0 is best, `FAILING` and more are failures. None: neither better nor worse than another."""
    parent: str = ""
    """Name of the entry that this one is a part of."""
    settings: Mapping[str, Value] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    broken: frozenset[str] = frozenset()
    """Checks whose budget is not kept."""
    judged: frozenset[str] | None = frozenset()
    """Checks that have a budget; None: all there are."""
    figures: Mapping[str, PhysicalFigure] = field(default_factory=dict)
    timings: Mapping[str, float | None] = field(default_factory=dict)
    """Times [s], or factors of them."""

    def keeps(self, check: str) -> bool:
        """Tell whether a check was judged and its budget kept."""
        return check not in self.broken and (self.judged is None or check in self.judged)


@dataclass(frozen=True, kw_only=True)
class View:
    """One scene's result."""

    scene: str
    """Name of the scene; of a study of stability, the study's."""
    command: str
    identity: Mapping[str, Value]
    """What is equal where the scene is the same; a value that is not known is None."""
    sample: Mapping[str, Value]
    """What was drawn, and how it was judged: seed, starts, budgets."""
    circumstances: Mapping[str, Value]
    """Versions and machine."""
    entries: Mapping[str, Entry]
    left_out: Mapping[str, str]
    """What cannot do the scene, each with the reason."""
