"""The order of measurement: cheap points first, competitors side by side, start after start."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mbds_xsim.base.isolate import core_count
from mbds_xsim.simulate.simulator import Simulator
from mbds_xsim.studies.tradeoff.bench import Job, StartBench
from mbds_xsim.studies.tradeoff.rows import Measurement
from mbds_xsim.studies.tradeoff.sweep import SPAN

Found = list[list[list[Measurement]]]
"""Rows by curve, by point and by start."""

_CHUNK = 4
"""Jobs a worker between two forecasts."""
_FINE_ENOUGH = 0.1
"""Part of the error budget below which no shorter step is asked for."""


def explore(bench: StartBench, curves: Sequence[Simulator]) -> Found:
    """Measure all points.

    The first start decides which points there are: all curves go on to the next shorter step
    together. The other starts follow one by one, all points of each in the order of their cost;
    so every point is measured once in each part of the whole time, and whatever disturbs the
    machine meanwhile disturbs all.
    """
    found: Found = [[] for _ in curves]
    while _wave(bench, curves, found):
        pass
    for start in range(1, len(bench.batch)):
        _round(bench, curves, found, start)
    return found


def _wave(bench: StartBench, curves: Sequence[Simulator], found: Found) -> bool:
    """Measure the next point of every curve; tell whether there was any."""
    bench.runner.meter.forecast(_left(bench, curves, found))
    jobs: list[tuple[int, Job]] = []
    asked = False
    for place, curve in enumerate(curves):
        rows = [point[0] for point in found[place]]
        count = _next_count(bench, curve, rows)
        if count is None:
            continue
        asked = True
        predicted = rollout_cost(rows, count, bench.scene.clock.duration)
        if predicted is not None and predicted > bench.limit:
            found[place].append([bench.too_slow(curve, count, predicted)])
        else:
            jobs.append((place, Job(curve, count, 0)))
    measured = bench.rows([job for _, job in jobs])
    for (place, _), row in zip(jobs, measured, strict=True):
        found[place].append([row])
    return asked


def _next_count(bench: StartBench, curve: Simulator, rows: Sequence[Measurement]) -> int | None:
    """Steps a frame of the next point; None where the curve is done."""
    if len(rows) == len(curve.counts):
        return None
    count = curve.counts[len(rows)]
    if count > SPAN and bench.truths.are_limits:
        return None
    if count > SPAN and rows and not _wants_more(bench, rows[-1]):
        return None
    return count


def _wants_more(bench: StartBench, last: Measurement) -> bool:
    """Whether a curve that spans two decades has not come far below the error budget yet."""
    allowed = bench.scene.budget.error_1s * bench.scene.length
    return last.error_m is not None and last.error_m > _FINE_ENOUGH * allowed


def _round(bench: StartBench, curves: Sequence[Simulator], found: Found, start: int) -> None:
    """Measure the points that the first start went through at a further one."""
    points = [
        (point, Job(curves[k], point[0].count, start))
        for k, points in enumerate(found)
        for point in points
        if point[0].kind == "done"
    ]
    points.sort(key=lambda pair: _cost(bench, pair[0][0]))
    costs = [cost_of(_cost(bench, point[0])) for point, _ in points]
    later = math.fsum(costs) * (len(bench.batch) - 1 - start)
    chunk = _CHUNK * (bench.runner.workers or core_count())
    for begin in range(0, len(points), chunk):
        bench.runner.meter.forecast(math.fsum(costs[begin:]) + later)
        part = points[begin : begin + chunk]
        for (point, _), row in zip(part, bench.rows([job for _, job in part]), strict=True):
            point.append(row)


def _left(bench: StartBench, curves: Sequence[Simulator], found: Found) -> float:
    """Work of the whole study that is left [s of one worker]."""
    pairs = zip(curves, found, strict=True)
    return math.fsum(_left_of_curve(bench, curve, points) for curve, points in pairs)


def _left_of_curve(
    bench: StartBench, curve: Simulator, points: Sequence[Sequence[Measurement]]
) -> float:
    """Work on the rest of the first start, and on the other starts of all points [s]."""
    rows = [point[0] for point in points]
    ahead = left_on(curve, rows, bench.scene.clock.duration, bench.limit)
    done = math.fsum(cost_of(_cost(bench, row)) for row in rows if row.kind == "done")
    return ahead + (ahead + done) * (len(bench.batch) - 1)


def _cost(bench: StartBench, row: Measurement) -> float:
    """Time of a rollout that was measured [s]."""
    return bench.scene.clock.duration * min(row.cpu_s, default=0.0)


_START = 1.0
"""Starting a process and judging a motion [s]."""
_REPEATS = 0.3
"""What short rollouts are repeated to [s]."""


def rollout_cost(rows: Sequence[Measurement], count: int, duration: float) -> float | None:
    """Predict the time of a rollout at a count of its curve [s]; None where nothing tells.

    The last two points tell how the cost grows, at most in proportion to the steps. Processor
    time is taken, which does not depend on what else the machine has to do.
    """
    done = [(row.count, float(np.median(row.cpu_s))) for row in rows if row.cpu_s]
    if not done:
        return None
    last, spent = done[-1]
    power = 1.0
    if len(done) > 1:
        before, less = done[-2]
        power = min(1.0, max(0.0, math.log(spent / less) / math.log(last / before)))
    return duration * spent * (count / last) ** power


def cost_of(rollout: float) -> float:
    """Time of a task with such a rollout [s]."""
    return _START + max(_REPEATS, rollout)


def left_on(curve: Simulator, rows: Sequence[Measurement], duration: float, limit: float) -> float:
    """Predict the time of the points of a curve that are still to come [s]."""
    counts = curve.counts[len(rows) :]
    costs = (rollout_cost(rows, count, duration) or 0.0 for count in counts if count <= SPAN)
    return sum(cost_of(cost) for cost in costs if cost <= limit)
