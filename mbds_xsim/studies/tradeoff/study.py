"""Speed against accuracy: work–precision diagrams of all engines, methods and steps."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import USUAL, Conduct, core_count
from mbds_xsim.measure.runner import machine, versions_of
from mbds_xsim.scene.sampling import distinct_starts, draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, fingerprint
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice, words_of
from mbds_xsim.simulate.claims import TRUTH
from mbds_xsim.simulate.simulator import EngineMethod, Simulator
from mbds_xsim.studies.tradeoff import SCHEMA, SPAN, Found, Measurement, Tradeoff, curves_of
from mbds_xsim.studies.tradeoff.bench import (
    LIMIT_COUNT,
    Job,
    StartBench,
    confirmations,
    first_impact,
    references,
)
from mbds_xsim.studies.tradeoff.curves import curve_results, ratios_of

STARTS = 3
LIMIT = 30.0
"""Longest rollout of one start [s]."""

_INTERVAL = "medium"  # low starts are easier, and high ones are chaos before anything can be told
_CHUNK = 4
"""Jobs a worker between two forecasts."""
_FINE_ENOUGH = 0.1
"""Part of the error budget below which no shorter step is asked for."""


def tradeoff(
    scene: Scene | str,
    *,
    engines: str | Iterable[str] = (),
    starts: int = STARTS,
    seed: int = 0,
    limit: float = LIMIT,
    workers: int | None = None,
    fresh: bool = False,
) -> Tradeoff:
    """Chart a scene's engines and give the figures.

    Args:
        scene: What to simulate, or the name or file of it.
        engines: One name or several; all installed ones and the reference when empty.
        starts: Starts of the medium interval.
        seed: Seed of starts and inputs.
        limit: Longest rollout of one start [s]; points that would take longer are only listed.
        workers: Processes at a time; all cores when left out, none but this one for 0.
        fresh: Whether points that were measured earlier are measured again.

    Raises:
        InputError: Something that was given cannot be used.
    """
    return tradeoff_with_rows(
        registry.load_scene(scene) if isinstance(scene, str) else scene,
        choice=Choice.parse(engines=words_of(engines) or None, also=(registry.REFERENCE,)),
        starts=starts,
        seed=seed,
        limit=limit,
        conduct=Conduct(workers, fresh=fresh),
        command="mbds_xsim.tradeoff",
    )[0]


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
    """Chart a scene, and keep the raw rows. See `tradeoff`."""
    begin = time.perf_counter()
    curves, left_out = curves_of(scene, choice.engines)
    left_out |= choice.faulty
    if not curves:
        msg = f"no engine can do {scene.name}: {next(iter(left_out.values()), 'none is installed')}"
        raise InputError(msg)
    batch = _draw(scene, starts, seed)
    solved = references(scene, batch, conduct)
    usual = {(curve.engine, curve.method): curve for curve in curves if not curve.variation}
    own = [key for key, curve in usual.items() if curve.family == TRUTH]
    bench = StartBench(
        scene=scene,
        batch=batch,
        references=solved,
        seed=seed,
        limit=limit,
        conduct=conduct,
        usual=usual,
        own=dict.fromkeys(own, confirmations(scene, batch, solved, conduct) if own else []),
    )
    found = explore(bench, curves)
    return _study(bench, curves, found, left_out, command, time.perf_counter() - begin)


def _study(
    bench: StartBench,
    curves: list[EngineMethod],
    found: Found,
    left_out: dict[str, str],
    command: str,
    wall_s: float,
) -> tuple[Tradeoff, list[Measurement]]:
    rows, scene = [row for points in found for rows in points for row in rows], bench.scene
    results = curve_results(scene, curves, found, own_limit=bench.are_limits)
    study = Tradeoff(
        schema=SCHEMA,
        scene=scene.name,
        description=scene.description,
        command=command,
        seed=bench.seed,
        trajectories=tuple(int(index) for index in bench.batch.index),
        horizon_s=bench.horizon,
        reference_ends_s=first_impact(bench.references),
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
        kept=bench.runner.kept,
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
    bench.conduct.meter.forecast(_left(bench, curves, found))
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
    if count > SPAN and (bench.are_limits or (rows and not _wants_more(bench, rows[-1]))):
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
    chunk = _CHUNK * (bench.conduct.workers or core_count())
    for begin in range(0, len(points), chunk):
        bench.conduct.meter.forecast(math.fsum(costs[begin:]) + later)
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
