"""Readers that turn stored results into views, one for each schema."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import read_bounded
from mbds_xsim.measure import result
from mbds_xsim.studies import match, stability, tradeoff
from mbds_xsim.studies.diff import FAILING, Entry, PhysicalFigure, Value, View, records
from mbds_xsim.studies.diff.plain import plain_view

T = TypeVar("T")

_RESULT = re.compile("mbds-xsim/[a-z-]+/1")
_VERDICTS = {"pass": 0, "warn": 1, "fail": FAILING}
_POINTS = {"failed": FAILING + 1, "crashed": FAILING + 1, "refused": FAILING + 1}
"""Ranks of points; those that were too slow or timed out have none: the machine decides that."""
_LARGEST = 100 * 10**6  # bytes of a file
_OUTCOMES = {"stable": 0, "off course": FAILING, "refused": None, "timed out": None}


def read_views(path: Path) -> tuple[str, dict[str, View]]:
    """Read a file that a command wrote with `--json`.

    Returns:
        The schema, and the views keyed by scene name.

    Raises:
        InputError: The file cannot be read, or does not hold results of one command.
    """
    content = _content(path)
    parts = content if isinstance(content, list) else [content]
    schemas = {_schema(part, path) for part in parts}
    if len(schemas) != 1:
        names = ", ".join(sorted(schemas)) or "an empty list"
        raise InputError(f"{path}: holds {names}; give a file of one command")
    (schema,) = schemas
    try:
        views = list(map(READERS[schema], parts)) if schema in READERS else [plain_view(parts)]
        return schema, _keyed_by_name((view.scene, view) for view in views)
    except (msgspec.ValidationError, InputError, OverflowError, LookupError) as error:
        raise InputError(f"{path}: is not what {schema} stands for: {error}") from error


def _content(path: Path) -> object:
    try:
        text = read_bounded(path, _LARGEST, ", the largest results take 10 MB")
        return msgspec.json.decode(text)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON, or was cut short: {error}") from error


def _schema(part: object, path: Path) -> str:
    schema = part.get("schema") if isinstance(part, dict) else None
    if isinstance(schema, str) and _RESULT.fullmatch(schema):
        return schema
    got = "no schema" if schema is None else f"schema {schema!r}"
    msg = f"{path}: has {got}; compared are mbds-xsim/<command>/1, as written with --json"
    raise InputError(msg)


def _keyed_by_name(pairs: Iterable[tuple[str, T]]) -> dict[str, T]:
    by_name: dict[str, T] = {}
    for name, item in pairs:
        if name in by_name:
            raise InputError(f"it has {name!r} twice")
        by_name[name] = item
    return by_name


def _validation(part: object) -> View:
    stored = result.from_plain(part, result.Validation)
    return _view(
        stored,
        ((f"{e.engine} {e.profile}", _engine_entry(e, stored)) for e in stored.engines),
        identity=_fields(stored, "length_m"),
        sample={"seed": stored.seed, "trajectories": len(stored.trajectories)},
    )


def _engine_entry(engine: result.EngineResult, stored: result.Validation) -> Entry:
    budget = stored.budget.get("error", 0.0) * stored.length_m
    settings = _fields(engine, "version", "method", "step_s", "coordinates", "constraints")
    findings = engine.findings
    late = bool(engine.failures) and all(map(records.is_late, engine.failures))
    broken = [f for f in findings if not f.passed and not (late and _keeps_where_known(f))]
    sound = not broken and not any(each.startswith("read-back: ") for each in engine.reasons)
    return Entry(
        verdict=engine.verdict,
        rank=None if late and sound else _VERDICTS.get(engine.verdict),
        settings={**settings, **engine.options},
        reasons=tuple(dict.fromkeys((*engine.reasons, *engine.failures))),
        broken=frozenset(finding.check for finding in broken),
        judged=frozenset(f.check for f in findings if f.budget is not None),
        figures={
            f.check: PhysicalFigure(_finite(f.figure), f.unit, f.budget or 0.0) for f in findings
        }
        | _figures(engine, "error_max_m", "agreement_time_s", error_max_m=budget),
        timings=_fields(engine, "wall_per_simulated_s", "setup_s"),
    )


def _keeps_where_known(finding: result.FindingResult) -> bool:
    """Return whether all trajectories keep a budget, except those that have no figure."""
    known = [figure for figure in finding.figures if figure is not None]
    return finding.budget is None or max(known, default=0.0) <= finding.budget


def _tradeoff(part: object) -> View:
    study = msgspec.convert(part, tradeoff.Tradeoff)
    limits = _fields(study, "horizon_s", "limit_s")
    return _view(
        study,
        _curve_entries(study),
        identity=_fields(study, "length_m", "duration_s"),
        sample={"seed": study.seed, "starts": len(study.trajectories), **limits},
    )


def _curve_entries(study: tradeoff.Tradeoff) -> Iterator[tuple[str, Entry]]:
    scales = {
        "error_m": study.budget.get("error_1s", 0.0) * study.length_m,
        "error_weighted_m": study.budget.get("error", 0.0) * study.length_m,
        "gap_m": study.budget.get("gap", 0.0),
        "energy": study.budget.get("energy", 0.0),
    }
    costs = next((ratio.wall_s for ratio in study.ratios if ratio.budget), ())
    for curve, cost in itertools.zip_longest(study.curves, costs[: len(study.curves)]):
        yield curve.name, _curve_entry(curve, cost, scales["error_m"])
        for point in curve.points:
            pace = f"{point.step_s:.12g} s" if point.rtol is None else f"rtol {point.rtol:g}"
            name = f"{curve.name}, {pace}"
            yield name, _point_entry(point, curve.name, scales)
    names, seen = Counter(model.name for model in study.models), Counter[str]()
    for model in study.models:
        name = model.name if names[model.name] == 1 else f"{model.name} of {model.source}"
        seen[name] += 1
        name += f" ({seen[name]})" if seen[name] > 1 else ""
        yield name, _point_entry(model.alone, "", scales)
        yield f"{name}, {model.at_once} at a time", _point_entry(model.batched, name, scales)


def _curve_entry(curve: tradeoff.CurveResult, cost: float | None, budget: float) -> Entry:
    done = [point for point in curve.points if point.kind == "done"]
    steps = [point.step_s for point in done if not point.broken]
    errors = [point.error_m for point in done if point.error_m is not None]
    return Entry(
        verdict="keeps all budgets" if steps else "keeps them at no step" if done else "not run",
        rank=0 if steps else FAILING if done else None,
        settings={"version": curve.version, "order declared": curve.order, **curve.options},
        figures={
            "order measured": PhysicalFigure(curve.measured_order),
            "longest step within all budgets": PhysicalFigure(max(steps, default=None), "s"),
            "smallest error": PhysicalFigure(min(errors, default=None), "m", budget),
        },
        timings={"wall time per simulated second at the budget": cost},
    )


def _point_entry(point: tradeoff.Point, curve: str, scales: Mapping[str, float]) -> Entry:
    done = point.kind == "done"
    verdict = "over budget" if point.broken else "all budgets kept"
    return Entry(
        verdict=verdict if done else point.kind,
        rank=FAILING * bool(point.broken) if done else _POINTS.get(point.kind),
        parent=curve,
        reasons=(point.reason,) if point.reason else (),
        broken=frozenset(point.broken),
        judged=None if done else frozenset(),
        figures=_figures(point, *scales, **scales),
        timings={"wall time per simulated second": point.wall_s},
    )


def _match(part: object) -> View:
    stored = result.from_plain(part, match.Match)
    sample = {
        "seed": stored.seed,
        "seed of the held-out": stored.held_out_seed,
        "starts of the search": stored.trajectories,
        "starts held out": stored.held_out,
    }
    entries = ((engine.engine, _matched_entry(engine)) for engine in stored.engines)
    return _view(stored, entries, identity={}, sample=sample)


def _matched_entry(engine: match.MatchedSettings) -> Entry:
    settings = _fields(engine, "version", "method", "steps_per_frame", "step_s")
    return Entry(
        verdict="keeps all budgets" if engine.meets_budget else "over budget",
        rank=0 if engine.meets_budget else FAILING,
        settings={**settings, **engine.options},
        reasons=engine.reasons,
        figures=_figures(engine, *result.FIGURES),
        timings={
            _LABELS[name]: _finite(getattr(engine, name))
            for name in ("wall_per_simulated_s", "cpu_per_simulated_s")
        },
    )


def _stability(part: object) -> View:
    sweep = msgspec.convert(part, stability.Survey)
    return _view(
        sweep,
        _panel_entries(sweep),
        identity=_fields(sweep, "duration_s"),
        sample={"criteria": sweep.criteria},
    )


def _panel_entries(sweep: stability.Survey) -> Iterator[tuple[str, Entry]]:
    panels = Counter(panel.name for panel in sweep.panels)
    for panel in sweep.panels:
        cells = [cell for row in panel.cells for cell in row]
        stable = sum(cell.outcome == "stable" for cell in cells)
        verdict = f"{stable} of {len(cells)} stable"
        source = f" of {cells[0].source}" if panels[panel.name] > 1 else ""
        parent = f"{panel.name}{source}"
        yield parent, Entry(verdict=verdict, rank=None, settings={"version": panel.version})
        for cell in cells:
            where = f"{sweep.quantity} {cell.value} {sweep.unit}".rstrip()
            name = f"{parent}, {where}, {cell.step_s:.12g} s"
            yield name, _cell_entry(cell, parent)


def _cell_entry(cell: stability.MapCell, panel: str) -> Entry:
    return Entry(
        verdict=cell.outcome,
        rank=_OUTCOMES.get(cell.outcome, FAILING + 1),
        parent=panel,
        settings={"who told": cell.told, **cell.options},
        reasons=(cell.reason,) if cell.reason else (),
        figures=_figures(cell, "error", "energy", "gap", "sunk", "way", "broke_s"),
        timings={"wall time": cell.wall_s},
    )


def _view(
    stored: Any,
    entries: Iterable[tuple[str, Entry]],
    *,
    identity: dict[str, Value],
    sample: Mapping[str, Value],
) -> View:
    """Make a view from the fields that results of all commands have, and from those given."""
    budgets = {f"budget {key}": value for key, value in getattr(stored, "budget", {}).items()}
    if hasattr(stored, "fingerprint"):
        identity = identity | {"fingerprint": stored.fingerprint or None}
    return View(
        scene=stored.scene if hasattr(stored, "scene") else stored.study,
        command=stored.command,
        identity=identity,
        sample={**sample, **budgets},
        circumstances={**getattr(stored, "versions", {}), "machine": stored.machine},
        entries=_keyed_by_name(entries),
        left_out=stored.left_out,
    )


_LABELS = {
    "length_m": "length [m]",
    "duration_s": "duration [s]",
    "horizon_s": "horizon [s]",
    "limit_s": "limit [s]",
    "step_s": "step [s]",
    "steps_per_frame": "steps a frame",
    "error_m": "error",
    "error_1s_m": "error at 1 s",
    "error_max_m": "largest error",
    "error_weighted_m": "error growth-weighted",
    "agreement_time_s": "agreement time",
    "gap_m": "gap",
    "constraint_gap_m": "gap",
    "energy_balance": "energy",
    "broke_s": "broke at",
    "wall_per_simulated_s": "wall time per simulated second",
    "cpu_per_simulated_s": "processor time per simulated second",
    "setup_s": "set-up",
}
"""Labels of fields; others keep their names."""


def _fields(stored: msgspec.Struct, *names: str) -> dict[str, Any]:
    return {_LABELS.get(name, name): getattr(stored, name) for name in names}


def _figures(stored: msgspec.Struct, *names: str, **scales: float) -> dict[str, PhysicalFigure]:
    """Collect figures, with units from the suffixes of their names, and budgets if any."""
    ends = {"m": "m", "s": "s"}
    return {
        _LABELS.get(name, name): PhysicalFigure(
            getattr(stored, name), ends.get(name.rpartition("_")[2], "1"), scales.get(name, 0.0)
        )
        for name in names
    }


def _finite(figure: float) -> float | None:
    return figure if math.isfinite(figure) else None


READERS: dict[str, Callable[[Any], View]] = {
    result.SCHEMA: _validation,
    tradeoff.SCHEMA: _tradeoff,
    match.SCHEMA: _match,
    stability.SCHEMA: _stability,
    records.ABLATION: records.ablation_view,
    records.CONTACT: records.contact_view,
    records.RELEASES: records.history_view,
}
"""Readers by `schema` that know ranks and budgets; `plain_view` reads all other results."""
