"""Log–log charts of a trade-off study: colour is the engine, marker the method."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from mbds_xsim.report import themed
from mbds_xsim.report.themed import DOTTED, GREY, INK, PAPER, level, note
from mbds_xsim.simulate.simulator import NATIVE
from mbds_xsim.studies.tradeoff import BATCH, CurveResult, ModelResult, Point, Tradeoff, words
from mbds_xsim.studies.tradeoff.curves import FLOOR

_NATIVE_MARKER = "*"
_MODEL_MARKER = "H"
_TOP = 10.0
"""Largest error that is drawn, over the scene's length."""
_REAL_TIME = 1.0
_X_LABELS = {"wall_s": "wall time per simulated second [s]", "step_s": "step [s]"}


@dataclass(frozen=True)
class Chart:
    """One chart of a study: its axes, budget and limits."""

    study: Tradeoff
    title: str
    y: str
    """Field of `Point` on the y axis."""
    y_label: str
    budget: float | None
    x: str = "wall_s"
    floor: float = 1e-12
    """Lower bound at which smaller values are drawn."""
    top: float = 1.0
    """Upper bound at which larger values are drawn."""
    front: bool = False

    @property
    def is_cost(self) -> bool:
        """Whether x is the cost; if not, it is the step."""
        return self.x == "wall_s"

    def spot(self, point: Point) -> tuple[float, float] | None:
        """Return the coordinates of a point; None if it has no value or no step to draw."""
        x, y = getattr(point, self.x), getattr(point, self.y)
        if x is None or y is None or not (self.is_cost or point.rtol is None):
            return None
        return x, min(max(y, self.floor), self.top)


def charts_of(study: Tradeoff) -> list[Chart]:
    """Return the charts that have anything to show."""
    length, budget = study.length_m, study.budget
    # Methods that only have their own limit are not held to the budgets of the error.
    judged = study.own_limit is None
    at_once = budget["error_1s"] * length if judged and not study.ends_early else None
    at_any = budget["error"] * length if judged else None
    name = _error_name(study)
    over_cost = Chart(
        study, f"{name}, over cost", "error_m", "RMS particle error [m]", at_once,
        floor=length * FLOOR, top=length * _TOP, front=True,
    )  # fmt: skip
    worst = f"worst error over {_span(study)}, over the growth of a disturbance"
    charts = [
        over_cost,
        replace(over_cost, title=f"{name}, over step", x="step_s", front=False),
        replace(
            over_cost, title=worst, y="error_weighted_m", y_label="max of error / max(1, G) [m]",
            budget=at_any, front=False,
        ),
        Chart(
            study, "energy that contact creates" if study.contact else "energy balance",
            "energy", "over the energy scale",
            budget.get("passivity" if study.contact else "energy_first_order"), top=10.0,
        ),
        Chart(study, "worst gap of a joint", "gap_m", "gap [m]", budget.get("gap")),
    ]  # fmt: skip
    points = [point for curve in study.curves for point in curve.points]
    return [c for c in charts if any(s is not None and s[1] > c.floor for s in map(c.spot, points))]


def draw_chart(axes: Any, chart: Chart) -> None:
    """Draw one chart."""
    axes.set_title(chart.title, fontsize=10, loc="left", color=INK)
    axes.set(xscale="log", yscale="log", xlabel=_X_LABELS[chart.x], ylabel=chart.y_label)
    if chart.front:
        _draw_front(axes, chart)
    for place, curve in enumerate(chart.study.curves):
        _draw_curve(axes, chart, curve, place)
    if chart.is_cost:
        for place, model in enumerate(chart.study.models):
            _draw_model(axes, chart, model, place)
    _levels(axes, chart)


def legend_entries(study: Tradeoff) -> Iterator[tuple[str, str, str]]:
    """Yield label, colour and marker of usual options, batches and trained models."""
    for curve in study.curves:
        if curve.variation == BATCH:
            yield f"{curve.name}, hollow", colour_of(curve.engine), marker_of(curve)
        elif not curve.variation:
            label = f"{curve.engine} {curve.method}, order {words.format_order(curve, study)}"
            yield label, colour_of(curve.engine), marker_of(curve)
    for name, model in {model.model: model for model in study.models}.items():
        label = f"{name}, trained; hollow: {model.at_once} at a time"
        yield label, themed.model_colour(model.model), _MODEL_MARKER


def tips(study: Tradeoff) -> dict[str, str]:
    """Return the tooltip of each point, keyed by the gid of its artist."""
    return {
        f"tip-{place}-{number}": words.point_tip(curve, point)
        for place, curve in enumerate(study.curves)
        for number, point in enumerate(curve.points)
    } | {f"tip-model-{place}": words.model_tip(model) for place, model in enumerate(study.models)}


def colour_of(engine: str) -> str:
    """Return the colour of an engine, the same on every page."""
    return themed.LIGHT[themed.engine_style(engine).colour]


def marker_of(curve: CurveResult) -> str:
    """Return the marker of a method, or of native settings."""
    return _NATIVE_MARKER if curve.variation == NATIVE else themed.marker_of(curve.method)


def _draw_curve(axes: Any, chart: Chart, curve: CurveResult, place: int) -> None:
    colour, marker = colour_of(curve.engine), marker_of(curve)
    varied, batch = curve.changed, curve.variation == BATCH
    size = 3.5 if varied else 10 if curve.variation == NATIVE else 5.5
    spots = [chart.spot(point) for point in curve.points]
    if chart.front and not varied and not any(spots):
        _draw_cost(axes, curve, colour)
    for run in _unbroken_runs(spots):
        look = {"lw": 0.6, "alpha": 0.35} if varied else {"lw": 1.4, "alpha": 0.9}
        axes.plot(*zip(*run, strict=True), color=colour, gid=f"curve-{place}", **look)
    for number, (point, spot) in enumerate(zip(curve.points, spots, strict=True)):
        if spot is None:
            continue
        if chart.is_cost and not varied:
            spread = [point.wall_low_s, point.wall_high_s]
            axes.plot(spread, [spot[1]] * 2, color=colour, lw=0.8, gid=f"curve-{place}")
        axes.plot(
            *([value] for value in spot), marker, color=colour, ms=size,
            mfc=PAPER if varied or batch else colour,
            mec=INK if curve.variation == NATIVE else colour, mew=0.8,
            alpha=0.6 if varied else 1.0, zorder=3, gid=f"tip-{place}-{number}",
        )  # fmt: skip


def _draw_cost(axes: Any, curve: CurveResult, colour: str) -> None:
    """Draw the least cost of a curve without errors as a vertical line."""
    cost = min((point.wall_s for point in curve.points if point.wall_s is not None), default=None)
    if cost is not None:
        axes.axvline(cost, color=colour, lw=1.4, ls="--")


def _draw_model(axes: Any, chart: Chart, model: ModelResult, place: int) -> None:
    """Draw a model with two marks: filled for one trajectory alone, hollow for a batch."""
    colour = themed.model_colour(model.model)
    spots = [chart.spot(point) for point in (model.alone, model.batched)]
    for spot, face in zip(spots, (colour, PAPER), strict=True):
        if spot is not None:
            axes.plot(
                *([value] for value in spot), _MODEL_MARKER, color=colour, markersize=6,
                markerfacecolor=face, zorder=4, gid=f"tip-model-{place}",
            )  # fmt: skip
    for run in _unbroken_runs(spots):
        axes.plot(*zip(*run, strict=True), color=colour, lw=0.6, alpha=0.5, gid="curve-model")


def _unbroken_runs(spots: list[tuple[float, float] | None]) -> Iterator[list[tuple[float, float]]]:
    """Yield runs of neighbouring points; a failed point breaks the line."""
    for _, group in itertools.groupby(spots, lambda spot: spot is None):
        run = [spot for spot in group if spot is not None]
        if len(run) > 1:
            yield run


def _draw_front(axes: Any, chart: Chart) -> None:
    spots = sorted(
        spot
        for curve in chart.study.curves
        for point in curve.points
        if point.on_front and (spot := chart.spot(point)) is not None
    )
    if spots:
        axes.plot(*zip(*spots, strict=True), color=GREY, lw=7, alpha=0.3, solid_joinstyle="round")


def _levels(axes: Any, chart: Chart) -> None:
    """Draw budget, real time and the accuracy of the reference."""
    if chart.budget is not None and any(len(line.get_ydata()) for line in axes.lines):
        level(axes, chart.budget, "budget")
    if chart.is_cost:
        left, right = axes.get_xlim()
        axes.set_xlim(left, max(right, 1.5 * _REAL_TIME))
        axes.axvline(_REAL_TIME, **DOTTED)
        note(axes, "real time", (_REAL_TIME, 0.02), ("data", "axes fraction"), ha="right")
    low, high = axes.get_ylim()
    if chart.floor > 1e-12 and low <= chart.floor * 1.5:
        axes.axhspan(low, chart.floor * 1.5, color=GREY, alpha=0.15, lw=0)
        note(axes, "accuracy of the reference", (0.01, chart.floor), ("axes fraction", "data"))
        axes.set_ylim(low, high)


def _error_name(study: Tradeoff) -> str:
    """Name the charted error and its time."""
    if study.own_limit is not None:
        return f"distance to the own run at {study.own_limit} steps a frame"
    if study.cut_short:
        return "error at the first impact"
    return f"error at {study.horizon_s:g} s"


def _span(study: Tradeoff) -> str:
    if study.reference_ends_s is None or study.own_limit is not None:
        return f"{study.duration_s:g} s"
    return f"the {study.reference_ends_s:.2g} s before the first impact"
