"""Texts and tables of a trade-off study, the same for terminal, page and Markdown."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator

from mbds_xsim.base.text import counted
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Column, Table, row_of, table_of
from mbds_xsim.simulate.simulator import NATIVE
from mbds_xsim.studies.tradeoff import CurveResult, ModelResult, Point, Ratio, Tradeoff

_NOTABLE_RATIO = 0.85
"""Ratio to the usual options' cost below which a changed option is worth a line."""
BUSY = 1.1
"""Ratio of wall time to processor time from which a machine counts as busy."""
_NUMBER = re.compile(r"[\d.]+(e[+-]?\d+)?")
_ORDER = "Order of convergence measured; in brackets the one declared for smooth motion"
_WITHIN = (
    "The cheapest point measured that keeps the budgets of all checks: step and wall time per "
    "simulated second"
)
_FINER_ACCURACIES = (1e-1, 1e-3)
"""Accuracies shown in addition to the budget, as fractions of it."""


def main_curves(study: Tradeoff) -> list[CurveResult]:
    """Return the curves of the main table: usual options and batches, then native settings."""
    shown = [curve for curve in study.curves if not curve.changed]
    return sorted(shown, key=lambda curve: curve.variation == NATIVE)


def main_table(study: Tradeoff) -> Table:
    """Build the main table: order, cost of some accuracies, and what is best, of each curve."""
    place, ratios = {id(curve): k for k, curve in enumerate(study.curves)}, _ratios_to_show(study)
    columns = [
        Column("engine", words=True),
        Column("method", words=True),
        Column("order", _ORDER),
        *itertools.chain.from_iterable(map(_ratio_columns, ratios)),
        Column("all budgets", _WITHIN),
        Column("best error", "Smallest error of all steps that were tried", narrow=False),
    ]
    rows = (
        row_of(
            (
                curve.engine,
                f"{curve.method} ({curve.variation})" if curve.variation else curve.method,
                format_order(curve, study),
                *itertools.chain.from_iterable(_costs(r, place[id(curve)]) for r in ratios),
                _within(curve),
                quantity.length(
                    min((p.error_m for p in curve.points if p.error_m is not None), default=None)
                ),
            ),
            "muted" if curve.variation else "",
        )
        for curve in main_curves(study)
    )
    return table_of(columns, rows, grouped=True)


def cheapest_within(study: Tradeoff, *, own: bool = False) -> tuple[CurveResult, Point] | None:
    """Find the cheapest point that keeps all budgets, without native settings; None if none does.

    With `own`, only methods that the engine itself integrates are considered.
    """
    curves = (c for c in study.curves if c.variation != NATIVE and (c.own or not own))
    pairs = [(c, p) for c in curves for p in c.points if p.error_m is not None and not p.broken]
    return min(pairs, key=lambda pair: pair[1].wall_s or math.inf, default=None)


def conclusion(study: Tradeoff) -> str:
    """Name the cheapest point within all budgets, in one sentence."""
    best = cheapest_within(study)
    if best is None:
        return "no point keeps the budgets of all checks"
    text = f"cheapest within all budgets: {_describe_place(study, *best)}"
    engine = None if best[0].own else cheapest_within(study, own=True)
    if engine is not None:
        text = f"{text}; of the engines {_describe_place(study, *engine)}"
    if study.own_limit is None and (study.ends_early or study.cut_short):
        end = "as the scene ends" if study.ends_early else "where an impact comes"
        text = f"{text}; {end} before 1 s, the budget at 1 s is not checked"
    return text


def _describe_place(study: Tradeoff, curve: CurveResult, point: Point) -> str:
    return (
        f"{curve.name} at {quantity.pace(point.step_s, point.rtol)}, "
        f"{quantity.span(point.wall_s)} a simulated second ({_speed(point)} real time), "
        f"{'error' if study.own_limit is None else 'from its own limit'} "
        f"{quantity.length(point.error_m)}"
    )


def describe_error(study: Tradeoff) -> str:
    """Explain how the charted error is measured, and at which time."""
    starts = f"{len(study.trajectories)} medium start{'s' * (len(study.trajectories) > 1)}"
    if not study.cut_short:
        return (
            f"RMS distance of the particles to the reference at {study.horizon_s:g} s, the worst "
            f"of {starts} (seed {study.seed})"
        )
    if study.own_limit is not None:
        return (
            f"RMS distance of the particles to the method's own run at {study.own_limit} steps a "
            f"frame, at {study.horizon_s:g} s, the worst of {starts} (seed {study.seed}): several "
            "spheres touch the ground from the start, and what follows has no unique solution in "
            "rigid contact; this shows convergence, not truth, and engines may converge to "
            "different motions"
        )
    return (
        f"RMS distance of the particles to the reference, the worst of {starts} (seed "
        f"{study.seed}), at the last frame before the first impact ({study.horizon_s:g} s the "
        "earliest): what follows has no unique solution in rigid contact"
    )


def options_that_pay(study: Tradeoff) -> list[str]:
    """List the cheapest changed option at the budget, for each method that gains from one."""
    budget = next((ratio for ratio in study.ratios if ratio.budget), None)
    if budget is None:
        return []
    usual = {
        (curve.engine, curve.method): cost
        for curve, cost in zip(study.curves, budget.wall_s, strict=True)
        if not curve.variation
    }
    cheapest: dict[tuple[str, str], tuple[float, str]] = {}
    for curve, cost in zip(study.curves, budget.wall_s, strict=True):
        method = (curve.engine, curve.method)
        base = usual.get(method)
        if cost and base and curve.changed and cost < _NOTABLE_RATIO * base:
            line = f"{curve.name}: {cost / base:.2g} × the cost at the budget"
            cheapest[method] = min((cost, line), cheapest.get(method, (math.inf, "")))
    return [line for _, line in cheapest.values()]


def machine_line(study: Tradeoff) -> str:
    """Name the machine that was timed, and say whether it was busy with other work."""
    text = f"{study.machine}, {counted(study.workers, 'process')} at a time"
    if study.busy < BUSY:
        return text
    return (
        f"{text}; it was busy: times are {_digits(study.busy)} × the processor's, in the median, "
        "so that costs are too high and scattered"
    )


def failures(study: Tradeoff) -> list[tuple[str, str, str]]:
    """List the points that did not finish: curves that ended alike, steps, reason.

    Of reasons that differ only in numbers, the first is listed.
    """
    alike: dict[tuple[str, str], list[str]] = {}
    for curve in study.curves:
        bad = [point for point in curve.points if point.kind != "done"]
        for _, group in itertools.groupby(bad, lambda p: (p.kind, _NUMBER.sub("", p.reason))):
            points = list(group)
            steps = ", ".join(quantity.pace(point.step_s, point.rtol) for point in points)
            cause = f"{points[0].kind}: {points[0].reason}"
            alike.setdefault((steps, cause), []).append(curve.name)
    return [("; ".join(names), steps, cause) for (steps, cause), names in alike.items()]


def _ratios_to_show(study: Tradeoff) -> list[Ratio]:
    """Return the ratios to show: at the budget, and at accuracies some decades below it."""
    ratios = [ratio for ratio in study.ratios if ratio.budget]
    for share in _FINER_ACCURACIES:
        accuracy = share * study.error_budget_m
        finer = [r for r in study.ratios if not r.budget and r.error_m <= accuracy * 1.01]
        ratios += finer[:1]
    return ratios


def _ratio_columns(ratio: Ratio) -> Iterator[Column]:
    accuracy = quantity.length(ratio.error_m)
    if ratio.budget:
        yield Column(
            f"cost ≤ {accuracy}",
            "Wall time per simulated second at the budget of the error, "
            f"{accuracy}, by interpolation",
        )
    yield Column(
        "ratio" if ratio.budget else f"at {accuracy}",
        f"Cost at an error of {accuracy} over that of the cheapest, by interpolation",
        narrow=ratio.budget,
    )


def _costs(ratio: Ratio, place: int) -> Iterator[str]:
    """Yield the cells of a curve under the columns of an accuracy."""
    cost = ratio.wall_s[place]
    if ratio.budget:
        yield quantity.span(cost)
    best = None if ratio.best is None else ratio.wall_s[ratio.best]
    yield quantity.NONE if cost is None or best is None else f"{_digits(cost / best)}×"


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def format_order(curve: CurveResult, study: Tradeoff) -> str:
    """Format the measured order and, without contact, the one declared for smooth motion."""
    measured = quantity.NONE if curve.measured_order is None else f"{curve.measured_order:.1f}"
    return measured if study.contact else f"{measured} ({curve.order})"


def _within(curve: CurveResult) -> str:
    points = [p for p in curve.points if p.wall_s is not None and not p.broken]
    if not points:
        return quantity.NONE
    best = min(points, key=lambda point: point.wall_s or math.inf)
    return f"{quantity.pace(best.step_s, best.rtol)}: {quantity.span(best.wall_s)}"


def _speed(point: Point) -> str:
    return f"{_digits(1.0 / point.wall_s)} ×" if point.wall_s else quantity.NONE


def point_tip(curve: CurveResult, point: Point) -> str:
    """Return the tooltip of a point of a curve."""
    over = f"over budget: {', '.join(point.broken)}" if point.broken else "within all budgets"
    step = f"step {quantity.span(point.step_s)} ({point.steps_per_frame} a frame)"
    return (
        f"{curve.name}\n{step if point.rtol is None else quantity.pace(point.step_s, point.rtol)}\n"
        f"cost {quantity.span(point.wall_s)} a simulated second "
        f"({quantity.span(point.wall_low_s)} to {quantity.span(point.wall_high_s)})\n"
        f"{_errors(point)}\n{over}"
    )


def model_tip(model: ModelResult) -> str:
    """Return the tooltip of a model's points."""
    return (
        f"{model.name}\ncost {quantity.span(model.alone.wall_s)} a simulated second alone, "
        f"{quantity.span(model.batched.wall_s)} in a batch of {model.at_once}\n"
        f"{_errors(model.alone)}\ntraining took {quantity.span(model.train_wall_s)}"
    )


def _errors(point: Point) -> str:
    return (
        f"error {quantity.length(point.error_m)}, over all times "
        f"{quantity.length(point.error_weighted_m)}\ngap {quantity.length(point.gap_m)}, energy "
        f"{quantity.number(point.energy)}"
    )


def models_table(study: Tradeoff) -> Table:
    """Build the table of trained models, one row each."""
    together = f"of {study.models[0].at_once}"
    error = "RMS distance of the particles to the reference then"
    energy = "Largest unexplained change of the particles' energy over its scale"
    columns = (
        Column("model", words=True),
        Column("trained on", "Training and seed", words=True),
        Column("alone", "Wall time per simulated second of one trajectory at a time"),
        Column(together, f"The same of one trajectory in a batch {together}"),
        Column(f"error {study.horizon_s:g} s", error),
        Column("all times", "The largest over the growth of a disturbance", narrow=False),
        Column("gap", "Largest deviation of a distance that no motion changes", narrow=False),
        Column("energy", energy, narrow=False),
        Column("steps", "Steps of training", narrow=False),
        Column("training", "Wall time of training"),
    )
    rows = (
        (
            model.model,
            f"{model.training} {model.variant}",
            *map(quantity.span, (model.alone.wall_s, model.batched.wall_s)),
            _error(model),
            *map(quantity.length, (model.alone.error_weighted_m, model.alone.gap_m)),
            quantity.number(model.alone.energy),
            quantity.NONE if model.train_steps is None else f"{model.train_steps:.0f}",
            quantity.span(model.train_wall_s),
        )
        for model in study.models
    )
    return table_of(columns, rows, title="Trained models")


def models_short(study: Tradeoff) -> str:
    """List the errors of all models in a sentence, the smallest first; "" without models."""
    models = sorted(study.models, key=lambda m: (m.alone.kind != "done", m.alone.error_m or 0.0))
    if not models:
        return ""
    errors = ", ".join(f"{m.model} {_error(m)}" for m in models)
    return f"trained models are off at {study.horizon_s:g} s by: {errors}"


def describe_models(study: Tradeoff) -> str:
    """Explain what models are given and what their figures mean; "" without models."""
    if not study.models:
        return ""
    known = study.models[0].known_frames
    return (
        f"start with the reference's first {known} frames, which no engine is given, and are not "
        "told the random forces, which engines are; wall time is that of the frames behind, alone "
        f"or as a share of a batch of {study.models[0].at_once} on one core; training is in no "
        "other time; gap and energy are what particles show" + _elsewhere(study)
    )


def _elsewhere(study: Tradeoff) -> str:
    other = dict.fromkeys(m.machine for m in study.models if m.machine != study.machine)
    return f"; timed on another machine than engines: {', '.join(other)}" if other else ""


def _error(model: ModelResult) -> str:
    point = model.alone
    return quantity.length(point.error_m) if point.kind == "done" else point.reason
