"""Speed against accuracy: work–precision diagrams of all engines, methods and steps."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import USUAL, Conduct, core_count
from mbds_xsim.measure.runner import machine, versions_of
from mbds_xsim.scene.sampling import distinct_starts, draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, fingerprint
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.claims import TRUTH
from mbds_xsim.simulate.simulator import EngineMethod, Simulator
from mbds_xsim.studies.tradeoff import SCHEMA, SPAN, CurveRows, Measurement, Tradeoff, curves_of
from mbds_xsim.studies.tradeoff.bench import LIMIT_COUNT, Job, StartBench, confirmations, references
from mbds_xsim.studies.tradeoff.curves import curve_results, ratios_of

STARTS = 3
LIMIT = 30.0
"""Longest rollout of one start [s]."""

_INTERVAL = "medium"  # low starts are easier; high ones turn chaotic before errors can be measured
_CHUNK = 4
"""Jobs per worker between two forecasts."""
_LOST = ("failed", "crashed")
"""Kinds of points that shorter steps may mend."""
_FINE_ENOUGH = 0.1
"""Part of the error budget below which no shorter step is tried."""


def tradeoff_with_rows(
    scene: Scene,
    *,
    choice: Choice,
    starts: int = STARTS,
    seed: int = 0,
    limit: float = LIMIT,
    conduct: Conduct = USUAL,
    command: str = "",
) -> tuple[Tradeoff, list[Measurement]]:
    """Measure speed against accuracy of engines on a scene.

    Returns:
        The study, and the raw rows.
    """
    begin = time.perf_counter()
    curves, left_out = able_curves(scene, choice)
    batch = _draw(scene, starts, seed)
    truths = references(scene, batch, conduct)
    usual = {(curve.engine, curve.method): curve for curve in curves if not curve.variation}
    own = [key for key, curve in usual.items() if curve.family == TRUTH]
    others = dict.fromkeys(own, confirmations(scene, batch, truths, conduct) if own else [])
    bench = StartBench(scene, batch, truths, seed, limit, conduct, usual, others)
    by_curve = explore(bench, curves)
    return _study(bench, curves, by_curve, left_out, command, time.perf_counter() - begin)


def able_curves(scene: Scene, choice: Choice) -> tuple[list[EngineMethod], dict[str, str]]:
    """List the curves of a scene's chart and what is left out; refuse a scene without any."""
    curves, left_out = curves_of(scene, choice.engines)
    left_out |= choice.faulty
    if not curves:
        msg = f"no engine can do {scene.name}: {next(iter(left_out.values()), 'none is installed')}"
        raise InputError(msg)
    return curves, left_out


def _study(
    bench: StartBench,
    curves: list[EngineMethod],
    by_curve: CurveRows,
    left_out: dict[str, str],
    command: str,
    wall_s: float,
) -> tuple[Tradeoff, list[Measurement]]:
    rows, scene = [row for points in by_curve for rows in points for row in rows], bench.scene
    results = curve_results(scene, curves, by_curve, own_limit=bench.are_limits)
    study = Tradeoff(
        schema=SCHEMA,
        scene=scene.name,
        description=scene.description,
        command=command,
        seed=bench.seed,
        trajectories=tuple(int(index) for index in bench.batch.index),
        horizon_s=bench.horizon,
        reference_ends_s=bench.reference_ends,
        own_limit=LIMIT_COUNT if bench.are_limits else None,
        duration_s=scene.clock.duration,
        length_m=scene.length,
        budget={key: getattr(scene.budget, key) for key in scene.budget.__struct_fields__},
        contact=bool(scene.contacts),
        limit_s=bench.limit,
        curves=results,
        ratios=ratios_of(scene, results),
        left_out=left_out,
        versions=versions_of({result.engine: result.version for result in results}),
        machine=machine(),
        workers=bench.conduct.processes,
        busy=_busy(rows),
        measured=bench.runner.measured,
        kept=bench.runner.reused,
        wall_s=wall_s,
        fingerprint=fingerprint(scene),
    )
    return study, rows


def _draw(scene: Scene, starts: int, seed: int) -> Batch:
    first = INTERVALS.index(_INTERVAL)
    count = distinct_starts(scene, starts)
    indices = range(first, first + count * len(INTERVALS), len(INTERVALS))
    return draw_batch(scene, indices, seed=seed)


def _busy(rows: list[Measurement]) -> float:
    shares = [sum(row.wall_s) / sum(row.cpu_s) for row in rows if sum(row.cpu_s) > 0]
    return float(np.median(shares)) if shares else 1.0


def explore(bench: StartBench, curves: Sequence[Simulator]) -> CurveRows:
    """Measure all points.

    The first start decides which points exist: all curves move on to the next shorter step
    together. The other starts follow one by one, each with all its points in the order of their
    cost. Every point is thus measured once in each part of the total time, so that other work on
    the machine disturbs all points alike.
    """
    by_curve: CurveRows = [[] for _ in curves]
    while _wave(bench, curves, by_curve):
        pass
    for start in range(1, len(bench.batch)):
        _round(bench, curves, by_curve, start)
    return by_curve


def _wave(bench: StartBench, curves: Sequence[Simulator], by_curve: CurveRows) -> bool:
    """Measure the next point of every curve; return whether there was any."""
    bench.conduct.meter.forecast(_remaining_work(bench, curves, by_curve))
    jobs: list[tuple[int, Job]] = []
    advanced = False
    for place, curve in enumerate(curves):
        rows = [point[0] for point in by_curve[place]]
        count = _next_count(bench, curve, rows)
        if count is None:
            continue
        advanced = True
        predicted = rollout_cost(rows, count, bench.scene.clock.duration)
        if predicted is not None and predicted > bench.limit:
            by_curve[place].append([bench.too_slow(curve, count, predicted)])
        else:
            jobs.append((place, Job(curve, count, 0)))
    measured = bench.rows([job for _, job in jobs])
    for (place, _), row in zip(jobs, measured, strict=True):
        by_curve[place].append([row])
    return advanced


def _next_count(bench: StartBench, curve: Simulator, rows: Sequence[Measurement]) -> int | None:
    """Return the steps (or digits) of a curve's next point; None if the curve is done."""
    if len(rows) == len(curve.counts):
        return None
    count = curve.counts[len(rows)]
    if count <= SPAN:
        return count
    # Further only while the error is not yet far below its budget, or the motion is lost.
    enough = _FINE_ENOUGH * (bench.scene.budget.error_1s * bench.scene.length)
    last = rows[-1] if rows else None
    goes_on = last is None or last.kind in _LOST or (last.error_m or 0.0) > enough
    return count if goes_on and not bench.are_limits else None


def _round(bench: StartBench, curves: Sequence[Simulator], by_curve: CurveRows, start: int) -> None:
    """Measure another start at all points that the first start completed."""
    points = [
        (point, Job(curves[k], point[0].count, start))
        for k, points in enumerate(by_curve)
        for point in points
        if point[0].kind == "done"
    ]
    points.sort(key=lambda pair: _cost(bench, pair[0][0]))
    costs = [cost_of(_cost(bench, point[0])) for point, _ in points]
    later = math.fsum(costs) * (len(bench.batch) - 1 - start)
    chunk = _CHUNK * (bench.conduct.workers or core_count())
    for begin in range(0, len(points), chunk):
        bench.conduct.meter.forecast(math.fsum(costs[begin:]) + later)
        part = points[begin : begin + chunk]
        for (point, _), row in zip(part, bench.rows([job for _, job in part]), strict=True):
            point.append(row)


def _remaining_work(bench: StartBench, curves: Sequence[Simulator], by_curve: CurveRows) -> float:
    """Predict the remaining work: rest of the first start, and other starts [s of one worker]."""
    parts = []
    for curve, points in zip(curves, by_curve, strict=True):
        rows = [point[0] for point in points]
        counts = [count for count in curve.counts[len(rows) :] if count <= SPAN]
        costs = [rollout_cost(rows, k, bench.scene.clock.duration) or 0.0 for k in counts]
        ahead = sum(cost_of(cost) for cost in costs if cost <= bench.limit)
        done = math.fsum(cost_of(_cost(bench, row)) for row in rows if row.kind == "done")
        parts.append(ahead + (ahead + done) * (len(bench.batch) - 1))
    return math.fsum(parts)


def _cost(bench: StartBench, row: Measurement) -> float:
    """Return the processor time of a measured rollout, its fastest repeat [s]."""
    return bench.scene.clock.duration * min(row.cpu_s, default=0.0)


_START = 1.0
"""Time to start a process and to judge a motion [s]."""
_REPEATS = 0.3
"""Total time for which a short rollout is repeated [s]."""


def rollout_cost(rows: Sequence[Measurement], count: int, duration: float) -> float | None:
    """Predict the time of a rollout at a count of its curve [s]; None if no row took any.

    The cost grows as between the last two points, at most in proportion to the steps. It is
    processor time, which does not depend on other work of the machine.
    """
    medians = ((row.count, float(np.median(row.cpu_s))) for row in rows if row.cpu_s)
    timed = [(steps, spent) for steps, spent in medians if spent > 0]  # clocks have a resolution
    if not timed:
        return None
    last, spent = timed[-1]
    power = 1.0
    if len(timed) > 1:
        before, less = timed[-2]
        power = min(1.0, max(0.0, math.log(spent / less) / math.log(last / before)))
    return duration * spent * (count / last) ** power


def cost_of(rollout: float) -> float:
    """Predict the time of a task from that of its rollout [s]."""
    return _START + max(_REPEATS, rollout)
