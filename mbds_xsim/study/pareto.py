"""Curves of cost and error: the front of all, what an accuracy costs, and the order."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

__all__ = ["cost_at", "front", "order_of"]

Pair = tuple[float, float]

_LEAST = 3  # points that show an order
_LEAST_SPAN = 4.0  # of the longest step over the shortest
_STRAIGHT = 0.08  # RMS residual of log10(error) up to which points lie on a line
_SATURATED = 0.03  # of the scene's length: larger errors follow no order


def front(pairs: Sequence[Pair]) -> set[int]:
    """Find the (cost, error) pairs that none is better than in one and as good in the other."""
    found: list[int] = []
    for place in sorted(range(len(pairs)), key=lambda k: pairs[k]):
        last = pairs[found[-1]] if found else (math.inf, math.inf)
        if pairs[place][1] < last[1] or pairs[place] == last:
            found.append(place)
    return set(found)


def cost_at(curve: Sequence[Pair | None], error: float) -> float | None:
    """Give the least cost at which a curve has an error or less.

    Between neighbouring points it is interpolated, both axes logarithmic. Beyond its points a
    curve tells nothing: None where all errors are larger, and where all are smaller, the cost of
    the cheapest point, since that was measured.

    Args:
        curve: (cost, error) in the order of the steps; None where a point failed, which breaks
            the curve.
        error: What is asked for.
    """
    costs = [point[0] for point in curve if point is not None and point[1] <= error]
    costs += [
        _crossing(one, other, error)
        for one, other in itertools.pairwise(curve)
        if one is not None and other is not None and (one[1] - error) * (other[1] - error) < 0
    ]
    return min(costs, default=None)


def order_of(pairs: Sequence[Pair], *, length: float, floor: float) -> float | None:
    """Fit the order of convergence to the asymptotic part of (step, error).

    That is the longest run of neighbouring points, of those the one of the shortest steps, that
    lie on a line in logarithms, without the errors that have saturated or lie in the accuracy of
    the reference. None where fewer than three points do.

    Args:
        pairs: Step and error in the order of the steps.
        length: Size of the scene, in the error's unit.
        floor: Errors up to this are not the method's.
    """
    usable = [pair if floor < pair[1] < _SATURATED * length else None for pair in pairs]
    for count in range(len(usable), _LEAST - 1, -1):
        for begin in range(len(usable) - count, -1, -1):
            slope = _slope(usable[begin : begin + count])
            if slope is not None:
                return slope
    return None


def _slope(pairs: Sequence[Pair | None]) -> float | None:
    """Slope of a line through the logarithms; None where a point lacks or lies off it."""
    known = [pair for pair in pairs if pair is not None]
    if len(known) < len(pairs) or known[0][0] < _LEAST_SPAN * known[-1][0]:
        return None
    step, error = np.log10(np.array(known)).T
    fit = np.polynomial.Polynomial.fit(step, error, 1)
    if np.sqrt(np.mean((fit(step) - error) ** 2)) > _STRAIGHT:
        return None
    return float(fit.convert().coef[1]) if len(fit.convert().coef) > 1 else 0.0


def _crossing(one: Pair, other: Pair, error: float) -> float:
    share = math.log(one[1] / error) / math.log(one[1] / max(other[1], 1e-300))
    return float(one[0] ** (1.0 - share) * other[0] ** share)
