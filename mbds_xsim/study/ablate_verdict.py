"""From the change that an effect makes to its verdict."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.study.ablate_effects import Effect
from mbds_xsim.study.ablate_floor import Window
from mbds_xsim.study.ablate_result import Floor, Row, Verdict

__all__ = ["impossible", "row_of"]

Array = NDArray[np.float64]


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
    verdict = _verdict(excess, window)
    return Row(
        effect=effect.name,
        factor=factor,
        left=effect.dropped,
        verdict=verdict,
        sentence="; ".join(filter(None, (_sentence(verdict, excess, apart, window), lost))),
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


def _verdict(excess: float, window: Window) -> Verdict:
    if excess > 1.0:
        return "needed"
    return "not needed" if window.reaches else "not resolvable"


def _sentence(verdict: Verdict, excess: float, apart: float, window: Window) -> str:
    if verdict == "needed":
        return f"motion changes by {_told(excess)} × the floor"
    if verdict == "not resolvable":
        return f"no more than {_told(excess)} of the floor until {window.ends}"
    if excess == 0.0:
        return "nothing changes"
    text = f"{_told(excess)} of the floor"
    if apart > 1.0:
        text += f", though {_told(apart)} × what engines differ by"
    return text


def _told(ratio: float) -> str:
    return f"{ratio:.0f}" if 10 <= ratio < 1e4 else f"{ratio:.2g}"
