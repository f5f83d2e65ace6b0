"""How good must data be? Errors on the truth against the cost and accuracy of the data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from mbds_xsim.learn.shift.domains import REFERENCE
from mbds_xsim.learn.shift.interaction import BEARABLE
from mbds_xsim.learn.shift.result import Harm, Shift
from mbds_xsim.learn.shift.worth import HARMFUL, NOTABLE, distances, noise_of, verdict
from mbds_xsim.report import themed
from mbds_xsim.report.blocks import Figure, Section, Table, plots
from mbds_xsim.report.quantity import number, with_unit
from mbds_xsim.studies.shift.changes import texts_of, titled_table
from mbds_xsim.studies.shift.figures import at, matrix_of, trained_models

SIZE = (10.4, 4.6)
_SINGLE = 2.0**-24
"""Rounding of positions over the scene's length: no data are drawn nearer to the truth."""

_BESIDE = 0.01
"""Distance of two models' marks for the same data, over what all data span."""
_NAME = 0.045
"""Least distance between the names above a chart, over the chart's width."""

Point = tuple[str, float, float]
"""A training: name, cost of its data [s] or their distance from the truth [m²], error [m²]."""


def costs_of(shift: Shift, model: str) -> list[Point]:
    """Return single-engine trainings by data cost: name, cost [s], error on the truth [m²]."""
    costs = {domain.name: domain.cost_s for domain in shift.domains}
    return _points(shift, model, costs)


def has_costs(shift: Shift) -> bool:
    """Whether the costs of several data that a model learned from are known."""
    return any(len(costs_of(shift, model)) > 1 for model in trained_models(shift))


def _points(shift: Shift, model: str, places: dict[str, float | None]) -> list[Point]:
    matrix = matrix_of(shift, model, at(shift, shift.at))
    points = [(name, places.get(name), matrix.entry(name, REFERENCE)) for name in matrix.homes]
    known = [(name, place, error) for name, place, error in points if place and error]
    return sorted(known, key=lambda each: each[1])


def worth_table(shift: Shift, place: int) -> Table:
    """Make a table of the data's cost and accuracy, and of the errors of models trained on them."""
    models, pick = trained_models(shift), at(shift, shift.frames[place])
    matrices = [matrix_of(shift, model, pick) for model in models]
    domains = [d for d in shift.domains if d.cost_s is not None or shift.harms]
    harms, later = (
        {(harm.model, harm.first): harm for harm in each}
        for each in (shift.harms, shift.harms_after_contact)
    )
    touched = shift.contact_place(shift.frames[place]) if later else 0
    since = shift.contact_frames[touched] if later else 0
    apart = distances(shift, place)
    rows = (
        (
            domain.name,
            with_unit(domain.cost_s, "s"),
            number(apart.get(domain.name)),
            *(
                number(matrix.entry(domain.name, REFERENCE))
                + _harm(", ×", harms.get((matrix.model, domain.name)), place)
                + _harm("; after contact ×", later.get((matrix.model, domain.name)), touched)
                for matrix in matrices
            ),
        )
        for domain in sorted(domains, key=lambda d: d.cost_s or 0.0)
        if any(domain.name in matrix.rows for matrix in matrices)
    )
    return titled_table(
        f"What training data cost, and what is learned from them, t = {shift.frames[place]}",
        "Processor time of the engine for a trajectory of its data, their mean squared distance "
        "[m²] from the independent reference, and the error against it of each model that was "
        "trained on them alone: the first row from which on dearer data bring no less error tells "
        "how good data must be. Beside it stands how many times the error it is of the model that "
        "learned from the reference's best data, and the 95 % interval: data are harmful where "
        f"that is significant, of all together, and {NOTABLE:g} or more, and harmless where "
        f"it is not and the interval is below {BEARABLE:g}"
        + (f"; after contact: {since} frames after the first" if later else ""),
        ("trained on", "a trajectory", "data", *models),
        rows,
    )


def _harm(before: str, harm: Harm | None, place: int) -> str:
    if harm is None or harm.value[place] is None:
        return ""
    value, low, high = texts_of(harm, place)
    return f"{before} {value} [{low}, {high}] {verdict(harm, place)}"


def worth_section(shift: Shift) -> Iterator[Section]:
    """Yield the chart of `draw_worth` with an explanation."""
    title = f"What data cost, and what is learned from them, t = {shift.at}"
    text = (
        "A point is a model that learned from one engine's data, held against the reference: over "
        "what a trajectory of the data cost, and over their own distance from the truth. Full "
        "where such data harm the model, with 95 % intervals. A line is the least error that so "
        "dear data, or cheaper ones, have brought: where it is level, cheaper data do as well."
    )
    figure = Figure(title, partial(draw_worth, shift=shift), SIZE, wide=True)
    return plots(title, [figure], text, folded=not shift.harms)


def draw_worth(figure: Any, shift: Shift) -> None:
    """Draw errors on the truth over the cost of data, and over their distance from the truth."""
    place, (dear, far) = shift.frames.index(shift.at), figure.subplots(1, 2, sharey=True)
    nearest = (_SINGLE * shift.length_m) ** 2
    apart = {name: max(x, nearest) for name, x in distances(shift, place).items()}
    models = trained_models(shift)
    for k, model in enumerate(models):
        points, look = costs_of(shift, model), {"color": themed.model_colour(model)}
        share = _BESIDE * (k - (len(models) - 1) / 2)
        least = list(itertools.accumulate((error for _, _, error in points), min))
        dear.step([cost for _, cost, _ in points], least, where="post", lw=1, **look)
        _draw_points(dear, shift, model, _beside(points, share))
        distant = _points(shift, model, {**apart})
        _draw_points(far, shift, model, _beside(distant, share), label=model)
    noise = noise_of(shift, place)
    for axes in (dear, far):
        axes.set(xscale="log", yscale="log")
        if noise:
            axes.axhline(noise, label="noise floor" if axes is far else None, **themed.DOTTED)
    ends = [noise or nearest, max(apart.values(), default=nearest)]
    far.plot(ends, ends, color=themed.INK, lw=0.9, ls="--", label="error of the data")
    named = {name: x for model in models for name, x, _ in costs_of(shift, model)}
    _name_lines(dear, named)
    _name_lines(far, {name: apart[name] for name in named if name in apart})
    dear.set_xlabel("processor time of the engine for a trajectory of training data [s]")
    dear.set_ylabel(f"squared error at t = {shift.at} [m²]")
    far.set_xlabel("squared distance of the training data from the truth [m²]")
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)


def _beside(points: Sequence[Point], share: float) -> list[Point]:
    """Move points on a logarithmic axis by a share of what they span, for all models to be seen."""
    places = [x for _, x, _ in points]
    factor = (max(places, default=1.0) / min(places, default=1.0)) ** share
    return [(name, x * factor, error) for name, x, error in points]


def _draw_points(
    axes: Any, shift: Shift, model: str, points: Sequence[Point], label: str | None = None
) -> None:
    """Draw a model's errors with their intervals, filled if the data harm it or harm is unknown."""
    place, colour = shift.frames.index(shift.at), themed.model_colour(model)
    harms = {harm.first: harm for harm in shift.harms if harm.model == model}
    for name, x, error in points:
        harm = harms.get(name)
        ends = _ends(harm, place, error) if harm else []
        axes.plot([x] * len(ends), ends, color=colour, lw=0.8)
        full = not harms or (harm is not None and verdict(harm, place) == HARMFUL)
        face = colour if full else themed.PAPER
        axes.plot([x], [error], "o", ms=5, color=colour, mfc=face, label=label)
        label = None


def _ends(harm: Harm, place: int, error: float) -> list[float]:
    """Return the interval of an error [m²], taking the error it is compared with as exact."""
    value, low, high = (each[place] for each in (harm.value, harm.low, harm.high))
    return [error * end / value for end in (low, high) if end is not None] if value else []


def _name_lines(axes: Any, named: dict[str, float]) -> None:
    """Name the data above the chart, near their places but with a least distance between names."""
    from scipy.optimize import isotonic_regression

    low, high = map(math.log10, axes.get_xlim())
    line, order = {"color": themed.GREY, "lw": 0.4}, sorted(named, key=named.__getitem__)
    places = (np.log10([named[name] for name in order]) - low) / (high - low)
    least = _NAME * np.arange(len(order))
    spread = isotonic_regression(places - least).x + least
    for name, place, shown in zip(order, places, spread, strict=True):
        axes.axvline(named[name], zorder=0, **line)
        axes.annotate(
            name, (place, 1.0), (shown, 1.05), "axes fraction", "axes fraction",
            {"arrowstyle": "-", "shrinkA": 0, "shrinkB": 0, "relpos": (0, 0), **line},
            rotation=60, ha="left", va="bottom", fontsize=6.5, color=themed.GREY,
        )  # fmt: skip
