"""Speed against accuracy: work–precision diagrams of all engines, methods and steps."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Silent, core_count
from mbds_xsim.measure.runner import Meter
from mbds_xsim.measure.store import machine, versions_of
from mbds_xsim.scene.sampling import distinct_starts, draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, fingerprint
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice, words_of
from mbds_xsim.simulate.claims import TRUTH
from mbds_xsim.simulate.simulator import EngineMethod
from mbds_xsim.studies.tradeoff.bench import (
    LIMIT_COUNT,
    StartBench,
    Truths,
    confirmations,
    first_impact,
    references,
)
from mbds_xsim.studies.tradeoff.curves import curve_results, ratios_of
from mbds_xsim.studies.tradeoff.explore import Found, explore
from mbds_xsim.studies.tradeoff.rows import SCHEMA, Measurement, Tradeoff
from mbds_xsim.studies.tradeoff.sweep import curves_of

STARTS = 3
LIMIT = 30.0
"""Longest rollout of one start [s]."""

_INTERVAL = "medium"  # low starts are easier, and high ones are chaos before anything can be told


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
        workers=workers,
        fresh=fresh,
        command="mbds_xsim.tradeoff",
    )[0]


def tradeoff_with_rows(
    scene: Scene,
    *,
    choice: Choice,
    starts: int = STARTS,
    seed: int = 0,
    limit: float = LIMIT,
    workers: int | None = None,
    fresh: bool = False,
    cache: bool = True,
    meter: Meter | None = None,
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
    how: dict[str, Any] = {"cache": cache, "workers": workers}
    solved = references(scene, batch, **how)
    usual = {(curve.engine, curve.method): curve for curve in curves if not curve.variation}
    own = [key for key, curve in usual.items() if curve.family == TRUTH]
    truths = Truths(
        scene=scene,
        batch=batch,
        references=solved,
        usual=usual,
        own=dict.fromkeys(own, confirmations(scene, batch, solved, **how) if own else []),
        limit=limit,
        workers=workers,
    )
    bench = StartBench.of(
        scene, batch, truths, seed=seed, limit=limit, fresh=fresh, meter=meter or Silent()
    )
    found = explore(bench, curves)
    rows = [row for points in found for rows in points for row in rows]
    study = _study(bench, curves, found, left_out, command, time.perf_counter() - begin)
    return msgspec.structs.replace(study, busy=_busy(rows)), rows


def _study(
    bench: StartBench,
    curves: list[EngineMethod],
    found: Found,
    left_out: dict[str, str],
    command: str,
    wall_s: float,
) -> Tradeoff:
    scene = bench.scene
    results = curve_results(scene, curves, found, own_limit=bench.truths.are_limits)
    return Tradeoff(
        schema=SCHEMA,
        scene=scene.name,
        description=scene.description,
        command=command,
        seed=bench.seed,
        trajectories=tuple(int(index) for index in bench.batch.index),
        horizon_s=bench.truths.horizon,
        reference_ends_s=first_impact(bench.truths.references),
        own_limit=LIMIT_COUNT if bench.truths.are_limits else None,
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
        workers=core_count() if bench.truths.workers is None else bench.truths.workers,
        busy=1.0,
        measured=bench.runner.measured,
        kept=bench.runner.kept,
        wall_s=wall_s,
        fingerprint=fingerprint(scene),
    )


def _draw(scene: Scene, starts: int, seed: int) -> Batch:
    first = INTERVALS.index(_INTERVAL)
    count = distinct_starts(scene, starts)
    indices = range(first, first + count * len(INTERVALS), len(INTERVALS))
    return draw_batch(scene, indices, seed=seed)


def _busy(rows: list[Measurement]) -> float:
    shares = [sum(row.wall_s) / sum(row.cpu_s) for row in rows if sum(row.cpu_s) > 0]
    return float(np.median(shares)) if shares else 1.0
