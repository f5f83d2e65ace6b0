"""From the change that an effect makes to its verdict."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.study.ablate_effects import Effect
from mbds_xsim.study.ablate_floor import Window
from mbds_xsim.study.ablate_result import Floor, Row, Verdict

__all__ = ["impossible", "row_of"]

Array = NDArray[np.float64]

_CLEARLY = 3.0
"""A change so many times the engines' distance shows even where these have parted."""


def row_of(
    effect: Effect, factor: float, change: Array, window: Window, floor: Floor, lost: str
) -> Row:
    """Hold a change to the floor.

    Args:
        effect: What was weakened.
        factor: How much of it was left.
        change: RMS particle change [m], shape (start, frame); NaN where a run had ended.
        window: Where it is judged.
        floor: What it must exceed.
        lost: Why the ablated runs ended early; empty where none did.
    """
    at_one, weighted = window.at_instant(change), window.weighted(change)
    at_one = at_one[np.isfinite(at_one)]
    worst_one = float(at_one.max()) if at_one.size else None
    worst = float(weighted.max())
    excess = max(worst / floor.overall, (worst_one or 0.0) / floor.at_1s)
    apart = max(
        _over(worst, floor.disagreement_m), _over(worst_one or 0.0, floor.disagreement_1s_m)
    )
    beyond = window.beyond(change)
    verdict = _verdict(excess, beyond, window)
    return Row(
        effect=effect.name,
        factor=factor,
        left=effect.dropped,
        verdict=verdict,
        sentence="; ".join(filter(None, (_sentence(verdict, excess, apart, beyond, window), lost))),
        change_1s_m=worst_one,
        change_1s_median_m=float(np.median(at_one)) if at_one.size else None,
        change_m=worst,
        change_median_m=float(np.median(weighted)),
        over_floor=excess,
        over_disagreement=apart if np.isfinite(apart) else None,
    )


def impossible(effect: Effect, factor: float, reason: str) -> Row:
    """Give the row of an effect that this scene cannot be without."""
    return Row(effect.name, factor, effect.dropped, "not possible", reason)


def _over(change: float, disagreement: float | None) -> float:
    if not change or disagreement is None:
        return 0.0
    return change / disagreement if disagreement else np.inf


def _verdict(excess: float, beyond: float, window: Window) -> Verdict:
    if excess > 1.0 or (not window.reaches and beyond > _CLEARLY):
        return "needed"
    return "not needed" if window.reaches else "not resolvable"


def _sentence(verdict: Verdict, excess: float, apart: float, beyond: float, window: Window) -> str:
    if excess > 1.0:
        return f"motion changes by {_told(excess)} × the floor"
    share = f"{_told(excess)} of the floor" if excess else "no change"
    if not window.reaches:
        past = f"{share} until {window.ends}; {_told(beyond)} × their distance at 1 s"
        return past if verdict == "needed" else f"{past}, clear is {_CLEARLY:g} ×"
    return f"{share}, though {_told(apart)} × what engines differ by" if apart > 1.0 else share


def _told(ratio: float) -> str:
    return f"{ratio:.0f}" if 10 <= ratio < 1e4 else f"{ratio:.2g}"
