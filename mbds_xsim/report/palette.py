"""One colour an engine, the same on every page: Okabe and Ito's, which colour-blind people tell
apart. The second set is lighter, for a dark background.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mbds_xsim import registry
from mbds_xsim.result import EngineResult

__all__ = ["DARK", "LIGHT", "Style", "styles"]

LIGHT = ("#009e73", "#cc79a7", "#0072b2", "#d55e00", "#e69f00", "#56b4e9")
DARK = ("#2fc79c", "#e8a0c8", "#56a8ec", "#ff8c42", "#f2bb3f", "#9ad8fa")

_DASHED = {"native"}


@dataclass(frozen=True)
class Style:
    """How an engine result is drawn."""

    colour: int
    """Place in the palettes."""
    dashed: bool
    """Native settings are dashed, beside the same engine's matched ones."""


def styles(results: Iterable[EngineResult]) -> tuple[Style, ...]:
    """Give each engine its colour: registered ones in their order, then the others."""
    listed = list(results)
    engines = [*registry.engine_names(), *(result.engine for result in listed)]
    place = {engine: k for k, engine in enumerate(dict.fromkeys(engines))}
    return tuple(
        Style(place[result.engine] % len(LIGHT), result.profile in _DASHED) for result in listed
    )
