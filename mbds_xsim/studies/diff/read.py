"""Stored results read into views, a reader for each schema."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.write import read_result
from mbds_xsim.measure import result
from mbds_xsim.studies.diff.plain import plain_view
from mbds_xsim.studies.diff.view import FAILING, Entry, Figure, Value, View
from mbds_xsim.studies.match import search as match
from mbds_xsim.studies.stability import rows as stability_rows
from mbds_xsim.studies.tradeoff import rows

T = TypeVar("T")

_RESULT = re.compile("mbds-xsim/[a-z]+/1")
_VERDICTS = {"pass": 0, "warn": 1, "fail": FAILING}
_POINTS = {"failed": FAILING + 1, "crashed": FAILING + 1, "refused": FAILING + 1}
"""Points that were too slow or timed out tell of the machine: they have no rank."""
_LARGEST = 100 * 10**6  # bytes of a file
_OUTCOMES = {"stable": 0, "off course": FAILING, "refused": None}


def read_views(path: Path) -> tuple[str, dict[str, View]]:
    """Read a file that a command wrote with `--json`.

    Returns:
        The schema, and the views by name of the scene.

    Raises:
        InputError: It cannot be read, or is not such a file.
    """
    content = _content(path)
    parts = content if isinstance(content, list) else [content]
    schemas = {_schema(part, path) for part in parts}
    if len(schemas) != 1:
        found = ", ".join(sorted(schemas)) or "an empty list"
        msg = f"{path}: holds {found}; give a file of one command"
        raise InputError(msg)
    (schema,) = schemas
    try:
        views = list(map(READERS[schema], parts)) if schema in READERS else [plain_view(parts)]
        return schema, _named((view.scene, view) for view in views)
    except (msgspec.ValidationError, InputError) as error:
        msg = f"{path}: is not what {schema} stands for: {error}"
        raise InputError(msg) from error


def _content(path: Path) -> object:
    try:
        text = read_result(path, _LARGEST + 1)
        if len(text) > _LARGEST:
            msg = f"{path}: got more than {_LARGEST // 10**6} MB, the largest results take 10 MB"
            raise InputError(msg)
        return msgspec.json.decode(text)
    except OSError as error:
        msg = f"cannot read {path}: {error.strerror or error}"
        raise InputError(msg) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        msg = f"{path}: is not JSON, or was cut short: {error}"
        raise InputError(msg) from error


def _schema(part: object, path: Path) -> str:
    schema = part.get("schema") if isinstance(part, dict) else None
    if isinstance(schema, str) and _RESULT.fullmatch(schema):
        return schema
    got = "no schema" if schema is None else f"schema {schema!r}"
    msg = f"{path}: has {got}; compared are mbds-xsim/<command>/1, as written with --json"
    raise InputError(msg)


def _named(pairs: Iterable[tuple[str, T]]) -> dict[str, T]:
    found: dict[str, T] = {}
    for name, what in pairs:
        if name in found:
            msg = f"it has {name!r} twice"
            raise InputError(msg)
        found[name] = what
    return found


def _validation(part: object) -> View:
    stored = result.from_plain(part, result.Validation)
    return View(
        scene=stored.scene,
        command=stored.command,
        identity={"length [m]": stored.length_m, "fingerprint": stored.fingerprint or None},
        sample={
            "seed": stored.seed,
            "trajectories": len(stored.trajectories),
            **_prefixed("budget", stored.budget),
        },
        circumstances=_circumstances(stored.versions, stored.machine),
        entries=_named(
            (f"{engine.engine} {engine.profile}", _engine_entry(engine, stored))
            for engine in stored.engines
        ),
        left_out=stored.left_out,
    )


def _engine_entry(engine: result.EngineResult, stored: result.Validation) -> Entry:
    budget = stored.budget.get("error", 0.0) * stored.length_m
    return Entry(
        verdict=engine.verdict,
        rank=_VERDICTS.get(engine.verdict),
        settings={
            "version": engine.version,
            "method": engine.method,
            "step [s]": engine.step_s,
            "coordinates": engine.coordinates,
            "constraints": engine.constraints,
            **engine.options,
        },
        reasons=tuple(dict.fromkeys((*engine.reasons, *engine.failures))),
        broken=frozenset(finding.check for finding in engine.findings if not finding.passed),
        judged=frozenset(f.check for f in engine.findings if f.budget is not None),
        figures={
            f.check: Figure(_finite(f.figure), f.unit, f.budget or 0.0) for f in engine.findings
        }
        | {
            "largest error": Figure(engine.error_max_m, "m", budget),
            "agreement time": Figure(engine.agreement_time_s, "s"),
        },
        timings={
            "wall time per simulated second": engine.wall_per_simulated_s,
            "set-up": engine.setup_s,
        },
    )


def _tradeoff(part: object) -> View:
    study = msgspec.convert(part, rows.Tradeoff)
    return View(
        scene=study.scene,
        command=study.command,
        identity={
            "length [m]": study.length_m,
            "duration [s]": study.duration_s,
            "fingerprint": study.fingerprint or None,
        },
        sample={
            "seed": study.seed,
            "starts": len(study.trajectories),
            "horizon [s]": study.horizon_s,
            "limit [s]": study.limit_s,
            **_prefixed("budget", study.budget),
        },
        circumstances=_circumstances(study.versions, study.machine),
        entries=_named(_curve_entries(study)),
        left_out=study.left_out,
    )


def _curve_entries(study: rows.Tradeoff) -> Iterator[tuple[str, Entry]]:
    scales = {
        "error": study.budget.get("error_1s", 0.0) * study.length_m,
        "weighted": study.budget.get("error", 0.0) * study.length_m,
        "gap": study.budget.get("gap", 0.0),
        "energy": study.budget.get("energy", 0.0),
    }
    costs = next((ratio.wall_s for ratio in study.ratios if ratio.budget), ())
    for curve, cost in itertools.zip_longest(study.curves, costs[: len(study.curves)]):
        yield curve.name, _curve_entry(curve, cost, scales["error"])
        for point in curve.points:
            name = f"{curve.name}, {point.step_s:.12g} s"
            yield name, _point_entry(point, curve.name, scales)


def _curve_entry(curve: rows.CurveResult, cost: float | None, budget: float) -> Entry:
    done = [point for point in curve.points if point.kind == "done"]
    kept = [point.step_s for point in done if not point.broken]
    errors = [point.error_m for point in done if point.error_m is not None]
    return Entry(
        verdict="keeps all budgets" if kept else "keeps them at no step" if done else "not run",
        rank=0 if kept else FAILING if done else None,
        settings={"version": curve.version, "order declared": curve.order, **curve.options},
        figures={
            "order measured": Figure(curve.measured_order),
            "longest step within all budgets": Figure(max(kept, default=None), "s"),
            "smallest error": Figure(min(errors, default=None), "m", budget),
        },
        timings={"wall time per simulated second at the budget": cost},
    )


def _point_entry(point: rows.Point, curve: str, scales: Mapping[str, float]) -> Entry:
    done = point.kind == "done"
    kept = "over budget" if point.broken else "all budgets kept"
    return Entry(
        verdict=kept if done else point.kind,
        rank=FAILING * bool(point.broken) if done else _POINTS.get(point.kind),
        parent=curve,
        reasons=(point.reason,) if point.reason else (),
        broken=frozenset(point.broken),
        judged=None if done else frozenset(),
        figures={
            "error": Figure(point.error_m, "m", scales["error"]),
            "error growth-weighted": Figure(point.error_weighted_m, "m", scales["weighted"]),
            "gap": Figure(point.gap_m, "m", scales["gap"]),
            "energy": Figure(point.energy, "1", scales["energy"]),
        },
        timings={"wall time per simulated second": point.wall_s},
    )


def _match(part: object) -> View:
    stored = result.from_plain(part, match.Match)
    return View(
        scene=stored.scene,
        command=stored.command,
        identity={"fingerprint": stored.fingerprint or None},
        sample={
            "seed": stored.seed,
            "seed of the held-out": stored.held_out_seed,
            "starts of the search": stored.trajectories,
            "starts held out": stored.held_out,
        },
        circumstances={"machine": stored.machine},
        entries=_named((found.engine, _found_entry(found)) for found in stored.engines),
        left_out=stored.left_out,
    )


def _found_entry(found: match.Found) -> Entry:
    return Entry(
        verdict="keeps all budgets" if found.meets_budget else "over budget",
        rank=0 if found.meets_budget else FAILING,
        settings={
            "version": found.version,
            "method": found.method,
            "steps a frame": found.steps_per_frame,
            "step [s]": found.step_s,
            **found.options,
        },
        reasons=found.reasons,
        figures={
            "error at 1 s": Figure(found.error_1s_m, "m"),
            "error growth-weighted": Figure(found.error_weighted_m, "m"),
            "gap": Figure(found.constraint_gap_m, "m"),
            "energy": Figure(found.energy_balance),
        },
        timings={
            "wall time per simulated second": _finite(found.wall_per_simulated_s),
            "processor time per simulated second": _finite(found.cpu_per_simulated_s),
        },
    )


def _stability(part: object) -> View:
    sweep = msgspec.convert(part, stability_rows.Sweep)
    return View(
        scene=sweep.study,
        command=sweep.command,
        identity={"duration [s]": sweep.duration_s},
        sample={"criteria": sweep.criteria},
        circumstances=_circumstances(sweep.versions, sweep.machine),
        entries=_named(_panel_entries(sweep)),
        left_out=sweep.left_out,
    )


def _panel_entries(sweep: stability_rows.Sweep) -> Iterator[tuple[str, Entry]]:
    for panel in sweep.panels:
        cells = [cell for row in panel.cells for cell in row]
        stable = sum(cell.outcome == "stable" for cell in cells)
        told = f"{stable} of {len(cells)} stable"
        yield panel.name, Entry(verdict=told, rank=None, settings={"version": panel.version})
        for cell in cells:
            where = f"{sweep.quantity} {cell.value} {sweep.unit}".rstrip()
            name = f"{panel.name}, {where}, {cell.step_s:.12g} s"
            yield name, _cell_entry(cell, panel.name)


def _cell_entry(cell: stability_rows.MapCell, panel: str) -> Entry:
    return Entry(
        verdict=cell.outcome,
        rank=_OUTCOMES.get(cell.outcome, FAILING + 1),
        parent=panel,
        settings={"who told": cell.told, **cell.options},
        reasons=(cell.reason,) if cell.reason else (),
        figures={
            "error": Figure(cell.error),
            "energy": Figure(cell.energy),
            "gap": Figure(cell.gap),
            "sunk": Figure(cell.sunk),
            "way": Figure(cell.way),
            "broke at": Figure(cell.broke_s, "s"),
        },
        timings={"wall time": cell.wall_s},
    )


def _finite(figure: float) -> float | None:
    return figure if math.isfinite(figure) else None


def _circumstances(versions: Mapping[str, str], machine: str) -> dict[str, Value]:
    return {**versions, "machine": machine}


def _prefixed(prefix: str, values: Mapping[str, float]) -> dict[str, Value]:
    return {f"{prefix} {key}": value for key, value in values.items()}


READERS: dict[str, Callable[[Any], View]] = {
    result.SCHEMA: _validation,
    rows.SCHEMA: _tradeoff,
    match.SCHEMA: _match,
    stability_rows.SCHEMA: _stability,
}
"""Readers that know what is better and what is a budget, by `schema`; `plain_view` has the rest."""
