"""Points, curves, Pareto front and cost of an accuracy, computed from raw rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.simulator import EngineMethod
from mbds_xsim.studies.tradeoff import CurveResult, CurveRows, Measurement, Point, Ratio

FLOOR = 1e-11
"""Accuracy of the reference, over the scene's length."""
_ROUNDING = 1e-9
"""Largest error that an engine's rounding may cause, over the scene's length."""
_WORST = ("setup_s", "error_m", "error_weighted_m", "gap_m", "energy")
"""Figures of a point that are the worst of its starts, and None if one has none."""
OWN_LIMIT = "distance to its own limit"
"""Check that is broken if a method has not converged and there is no reference."""


def curve_results(
    scene: Scene, curves: Sequence[EngineMethod], by_curve: CurveRows, *, own_limit: bool = False
) -> tuple[CurveResult, ...]:
    """Summarise the rows of all curves; `by_curve` is in the order of `curves`.

    With `own_limit`, errors are distances to a method's own limit. A small distance does not show
    that a motion is true, but a large one shows that it is wrong: the error's budget applies.
    """
    summary = [
        [_against_limit(scene, p) if own_limit else p for p in map(point_of, points)]
        for points in by_curve
    ]
    return tuple(
        _curve_result(scene, curve, points)
        for curve, points in zip(curves, _with_front(summary, FLOOR * scene.length), strict=True)
    )


def _against_limit(scene: Scene, point: Point) -> Point:
    """Judge a distance to a method's own limit.

    If the limit could not be simulated, the point counts as far from it. A distance of exactly 0
    is dropped: other settings led to the same steps, so the run was compared with itself.
    """
    if point.error_m == 0.0:
        return msgspec.structs.replace(point, error_m=None, error_weighted_m=None)
    distance = math.inf if point.error_m is None else point.error_m
    if point.kind != "done" or distance <= scene.budget.error_1s * scene.length:
        return point
    return msgspec.structs.replace(point, broken=(*point.broken, OWN_LIMIT))


def point_of(rows: Sequence[Measurement]) -> Point:
    """Summarise the starts of one setting: median run times, and the worst of other figures."""
    first = rows[0]
    bad = next((row for row in rows if row.kind != "done"), None)
    point = Point(
        steps_per_frame=first.steps_per_frame,
        step_s=first.step_s,
        rtol=first.rtol,
        kind=bad.kind if bad else "done",
        reason=_reason(bad, rows) if bad else "",
        starts=sum(row.kind == "done" for row in rows),
    )
    if bad:
        return point
    walls = list(itertools.chain.from_iterable(row.wall_s for row in rows))
    return msgspec.structs.replace(
        point,
        wall_s=float(np.median([np.median(row.wall_s) for row in rows])),
        wall_low_s=min(walls),
        wall_high_s=max(walls),
        cpu_s=float(np.median([np.median(row.cpu_s) for row in rows])),
        **{name: _worst(rows, name) for name in _WORST},
        broken=tuple(dict.fromkeys(check for row in rows for check in row.broken)),
    )


def ratios_of(scene: Scene, curves: Sequence[CurveResult]) -> tuple[Ratio, ...]:
    """Compute the cost of accuracies: the budget, and powers of ten that any curve reaches."""
    budget, floor = scene.budget.error_1s * scene.length, FLOOR * scene.length
    errors = [max(p.error_m, floor) for c in curves for p in c.points if p.error_m is not None]
    if not errors:
        return ()
    low, high = (math.log10(e) for e in (min(errors), min(max(errors), 10 * budget)))
    decades = [10.0**k for k in range(math.floor(high), math.ceil(low) - 1, -1)]
    each = [(budget, True), *((error, False) for error in decades)]
    return tuple(_ratio(curves, error, is_budget=is_budget) for error, is_budget in each)


def _ratio(curves: Sequence[CurveResult], error: float, *, is_budget: bool) -> Ratio:
    costs = [cost_at([_pair(p.wall_s, p.error_m) for p in c.points], error) for c in curves]
    known = [k for k, cost in enumerate(costs) if cost is not None]
    best = min(known, key=lambda k: costs[k] or math.inf, default=None)
    return Ratio(error_m=error, budget=is_budget, wall_s=tuple(costs), best=best)


def _curve_result(scene: Scene, curve: EngineMethod, points: list[Point]) -> CurveResult:
    adapter = registry.load_adapter(curve.engine)
    method = adapter.methods[curve.method]
    pairs = [(p.step_s, math.nan if p.error_m is None else p.error_m) for p in points]
    return CurveResult(
        engine=curve.engine,
        version=curve.version,
        method=curve.method,
        family=method.family,
        own=method.own,
        variation=curve.variation,
        options=curve.options(scene),
        order=method.order_for(scene),
        measured_order=order_of(pairs, length=scene.length, floor=_ROUNDING * scene.length),
        points=tuple(points),
    )


def _with_front(curves: list[list[Point]], floor: float) -> list[list[Point]]:
    """Mark the points of the Pareto front; errors below the floor count as equal."""
    pairs = {
        (k, n): pair
        for k, points in enumerate(curves)
        for n, point in enumerate(points)
        if (pair := _pair(point.wall_s, point.error_m)) is not None
    }
    places = list(pairs)
    best = {places[k] for k in front([(cost, max(e, floor)) for cost, e in pairs.values()])}
    return [
        [msgspec.structs.replace(p, on_front=(k, n) in best) for n, p in enumerate(points)]
        for k, points in enumerate(curves)
    ]


def _pair(cost: float | None, error: float | None) -> tuple[float, float] | None:
    if cost is None or error is None or not math.isfinite(error):
        return None
    return cost, error


def _worst(rows: Iterable[Measurement], figure: str) -> float | None:
    values = [getattr(row, figure) for row in rows]
    return None if None in values else max(values)


def _reason(bad: Measurement, rows: Sequence[Measurement]) -> str:
    """Return the reason of a failure, naming the start if it is not the first."""
    return bad.reason if bad is rows[0] else f"start {bad.trajectory}: {bad.reason}"


Pair = tuple[float, float]

_LEAST = 3  # fewest points that show an order
_LEAST_SPAN = 4.0  # least ratio of the longest step to the shortest
_STRAIGHT = 0.08  # largest RMS residual of log10(error) for points on a line
_SATURATED = 0.03  # part of the scene's length: larger errors follow no order


def front(pairs: Sequence[Pair]) -> set[int]:
    """Find the Pareto front: indices of the (cost, error) pairs that no other pair dominates."""
    indices: list[int] = []
    for place in sorted(range(len(pairs)), key=lambda k: pairs[k]):
        last = pairs[indices[-1]] if indices else (math.inf, math.inf)
        if pairs[place][1] < last[1] or pairs[place] == last:
            indices.append(place)
    return set(indices)


def cost_at(curve: Sequence[Pair | None], error: float) -> float | None:
    """Return the least cost at which a curve has at most a given error.

    Between neighbouring points it is interpolated on logarithmic axes. It is not extrapolated: it
    is None if all errors are larger; if all are smaller, it is the cost of the cheapest point,
    which was measured.

    Args:
        curve: (cost, error) in the order of the steps; None where a point failed, which breaks
            the curve.
        error: Largest error allowed.
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

    This part is the longest run of neighbouring points on a line in log–log axes; of equally long
    runs, the one with the shortest steps. Saturated errors and errors up to `floor` do not count.
    The result is None if no run has three points and steps that span a factor of four.

    Args:
        pairs: Step and error in the order of the steps.
        length: Size of the scene, in the error's unit.
        floor: Largest error that need not come from the method.
    """
    usable = [pair if floor < pair[1] < _SATURATED * length else None for pair in pairs]
    for count in range(len(usable), _LEAST - 1, -1):
        for begin in range(len(usable) - count, -1, -1):
            slope = _slope(usable[begin : begin + count])
            if slope is not None:
                return slope
    return None


def _slope(pairs: Sequence[Pair | None]) -> float | None:
    """Return the slope in log–log axes; None if points are missing, too close or off a line."""
    known = [pair for pair in pairs if pair is not None]
    if len(known) < len(pairs) or known[0][0] < _LEAST_SPAN * known[-1][0]:
        return None
    step, error = np.log10(np.array(known)).T
    fit = np.polynomial.Polynomial.fit(step, error, 1)
    if np.sqrt(np.mean((fit(step) - error) ** 2)) > _STRAIGHT:
        return None
    return float(fit.convert().coef[1]) if len(fit.convert().coef) > 1 else 0.0


def _crossing(one: Pair, other: Pair, error: float) -> float:
    here, there = (max(pair[1], 1e-300) for pair in (one, other))  # an error may be exactly 0
    share = math.log(here / error) / math.log(here / there)
    return float(one[0] ** (1.0 - share) * other[0] ** share)
