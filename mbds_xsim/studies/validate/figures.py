"""Plots of a validation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, TypeVar

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.measure.result import EngineResult, Evidence, Validation
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Figure, chart
from mbds_xsim.report.themed import DOTTED, GREY, INK, LIGHT, PAPER, Style, engine_style, level
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.studies.validate import words
from mbds_xsim.studies.validate.motion import Contact

T = TypeVar("T")

_SIZE = (4.5, 3.1)
_FLOOR = 1e-16
"""Value at which zero is drawn on the log axis."""
_GROWTH_LIMIT = 100.0
"""Growth beyond which an error is chaos and not judged."""
_AGREEMENT = 0.01
"""Share of the scene's length up to which trajectories agree."""


def styles(results: Iterable[EngineResult]) -> tuple[Style, ...]:
    """Return a style per result, solid only for each engine's first profile that is not native."""
    listed = list(results)
    others = [result.engine for result in listed]
    first = {r.engine: r.profile for r in reversed(listed) if r.profile != "native"}
    return tuple(
        engine_style(r.engine, others, dashed=r.profile != first.get(r.engine)) for r in listed
    )


def error_growth(validation: Validation, evidence: Evidence) -> list[Figure]:
    """Plot the worst error against time, one figure for each sampling interval."""
    known = np.any(evidence.reference.known[:, 1:], axis=1)
    of_row = [evidence.batch.interval(row) for row in range(len(evidence.batch))]
    return [
        _error_figure(validation, evidence, rows, interval)
        for interval in INTERVALS
        if (rows := [k for k, name in enumerate(of_row) if name == interval and known[k]])
        and any(error is not None and np.isfinite(error[rows]).any() for error in evidence.errors)
    ]


def plotted_checks(evidence: Evidence) -> list[str]:
    """List the checks to plot over time, except error and consistency, in the audit's order."""
    checks = dict.fromkeys(check for series in evidence.series for check in series)
    return [
        check
        for check in checks
        if not check.startswith(("error", "consistency")) and _has_course(evidence, check)
    ]


def check_series(validation: Validation, evidence: Evidence, check: str) -> Figure:
    """Plot a check's series against time, worst of all trajectories, with its budgets."""
    findings = [f for result in validation.engines for f in result.findings if f.check == check]
    unit = next((finding.unit for finding in findings), "")

    def draw(axes: Any) -> None:
        for place, (series, style) in enumerate(styled(validation, evidence.series)):
            if check in series:
                _curve(axes, evidence.reference.time, _worst(series[check]), style, place)
        for first in words.ends(validation)[:1]:
            axes.axvline(first, color=GREY, linewidth=0.9)
        budgets = sorted({f.budget for f in findings if f.budget})
        for budget in budgets:
            level(axes, budget, f"budget {quantity.with_unit(budget, unit)}")
        _log_axis(axes, "" if unit in ("", "1") else unit, *budgets)

    return chart(f"{check} over time", draw, _SIZE, caption=check)


def matrix(validation: Validation) -> Figure | None:
    """Draw the distances between all pairs as a heat map with its numbers; None without pairs."""
    values = np.array(validation.matrix_m, dtype=np.float64)
    off = np.where(np.eye(len(values), dtype=bool) | ~np.isfinite(values), np.nan, values)
    kept = np.flatnonzero(np.isfinite(off).any(axis=0))
    if not len(kept):
        return None
    names, shown, count = [validation.names[k] for k in kept], off[np.ix_(kept, kept)], len(kept)
    of_engine = {
        words.label(result): LIGHT[style.colour]
        for result, style in styled(validation, validation.engines)
    }
    colours = [of_engine.get(name, INK) for name in names]
    size = (1.7 + 0.62 * count, 1.2 + 0.42 * count)
    caption = (
        f"RMS particle distance at {validation.matrix_s:.4g} s between all pairs, worst of the low "
        "and medium trajectories"
    )
    draw = partial(_heat, names=names, shown=shown, colours=colours)
    return chart("distances between all pairs", draw, size, caption=caption, wide=True)


def consistency(validation: Validation) -> Figure | None:
    """Plot every trajectory's consistency over its budget; None if no engine has any."""
    rows = [
        (style, [f for f in result.findings if f.check.startswith("consistency") and f.budget])
        for result, style in styled(validation, validation.engines)
    ]
    checks = list(dict.fromkeys(f.check for _, findings in rows for f in findings))
    if not checks:
        return None
    marker = dict(zip(checks, "1x+234|" * 9, strict=False))

    def draw(axes: Any) -> None:
        for place, (style, findings) in enumerate(rows):
            look = {"color": LIGHT[style.colour], "alpha": 0.8, "ms": 7}
            for f in findings:
                ratio = _clip(np.array(f.figures, dtype=np.float64) / (f.budget or 1.0))
                height = np.full(len(ratio), -place - 0.12 * checks.index(f.check))
                axes.plot(ratio, height, marker[f.check], **look)
        axes.axvline(1.0, **DOTTED)
        axes.set_xscale("log")
        axes.set_xlabel("figure over budget, one mark a trajectory (right of 1: inconsistent)")
        axes.set_yticks(-np.arange(len(rows)), [words.label(r) for r in validation.engines])
        for check, symbol in marker.items():
            axes.plot([], [], symbol, color=GREY, label=check)
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=len(marker), frameon=False)

    size = (7.2, 1.3 + 0.34 * len(rows))
    return chart("consistency over its budget", draw, size, wide=True)


def restitution(
    validation: Validation, evidence: Evidence, contacts: tuple[Contact | None, ...]
) -> Figure | None:
    """Plot the measured restitution of single impacts against their speed; None without impacts.

    `contacts` lists the reference first, then the engine results.
    """
    ground = evidence.scene.ground
    impacts = [None if contact is None else _impacts(contact) for contact in contacts]
    if ground is None or not any(speed.size for speed, _ in filter(None, impacts)):
        return None

    e = ground.restitution
    judged = any(f.check == "restitution" for r in validation.engines for f in r.findings)

    def draw(axes: Any) -> None:
        looks = (None, *styles(validation.engines))
        for place, (points, style) in enumerate(zip(impacts, looks, strict=True)):
            if points is not None:
                colour = INK if style is None else LIGHT[style.colour]
                hollow = style is None or style.dashed
                (marks,) = axes.plot(
                    *points, "|12x+34"[place % 7], color=colour, ms=9 if style is None else 5,
                    mfc="none" if hollow else colour, mew=1.1, alpha=0.85,
                )  # fmt: skip
                if style is not None:
                    marks.set_gid(f"curve-{place - 1}")
        axes.axhline(e, **DOTTED)
        band = ""
        if judged:
            allowed = validation.budget["restitution"]
            band = f", the budget is {allowed:g} (grey)"
            axes.axhspan(e - allowed, e + allowed, color=GREY, alpha=0.14, linewidth=0)
        axes.set_title(f"dotted: the scene's {e:.4f}{band}", loc="right", fontsize=8)
        axes.set(xlabel="speed of impact [m/s]", ylabel="speed after over before")
        axes.margins(x=0.06, y=0.15)

    caption = "Restitution delivered: each mark is one impact of one sphere, of all trajectories"
    return chart("restitution delivered", draw, _SIZE, caption=caption)


def _impacts(contact: Contact) -> tuple[Array, Array]:
    """Return the speeds of single impacts [m/s], and the ratios of speed after to speed before."""
    arriving = np.concatenate([episode.arriving for episode in contact.episodes])
    leaving = np.concatenate([episode.leaving for episode in contact.episodes])
    return arriving, leaving / arriving


def _error_figure(
    validation: Validation, evidence: Evidence, rows: list[int], interval: str
) -> Figure:
    time, length = evidence.reference.time, validation.length_m
    judged_at_1s = any(evidence.batch.interval(row) != INTERVALS[-1] for row in rows)

    def draw(axes: Any) -> None:
        _sensitivity_band(axes, time, evidence.growth[rows], validation.budget["error"] * length)
        for place, (error, style) in enumerate(styled(validation, evidence.errors)):
            if error is not None:
                _curve(axes, time, _worst(error[rows]), style, place)
        level(axes, _AGREEMENT * length, "agreement: 1 % of length")
        if judged_at_1s and time[-1] >= 1.0:
            axes.plot([1.0], [validation.budget["error_1s"] * length], "v", color=INK, ms=7)
        _no_solution(axes, time, evidence.reference.known[rows])
        _log_axis(axes, "RMS particle error [m]", _AGREEMENT * length)

    caption = f"Error, {interval} interval" if len(evidence.batch) > 1 else "Error"
    return chart("error growth", draw, _SIZE, caption=caption)


def styled(validation: Validation, each: Iterable[T]) -> Iterator[tuple[T, Style]]:
    """Pair one item per engine result with the style of the result."""
    return zip(each, styles(validation.engines), strict=True)


def _no_solution(axes: Any, time: Array, known: Mask) -> None:
    """Hatch the time beyond the earliest first impact of the trajectories."""
    last = int(known.sum(axis=1).min()) - 1
    if last + 1 < len(time):
        axes.axvspan(time[last], time[-1], facecolor="none", edgecolor=GREY, alpha=0.45, hatch="//")
        axes.annotate(
            "beyond the first impact:\nno unique solution", (0.98, 0.06), xycoords="axes fraction",
            ha="right", fontsize=8, color=INK,
            bbox={"facecolor": PAPER, "alpha": 0.85, "edgecolor": "none", "pad": 2},
        )  # fmt: skip


def _sensitivity_band(axes: Any, time: Array, growth: Array, budget: float) -> None:
    """Shade the allowed error: the budget times the growth of a disturbance of the start."""
    grown = np.maximum(1.0, growth)
    allowed = np.fmax.reduce(np.where(grown < _GROWTH_LIMIT, budget * grown, np.nan))
    axes.fill_between(time, _FLOOR, allowed, color=GREY, alpha=0.14, linewidth=0)
    axes.plot(time, allowed, color=GREY, linewidth=1.0)


def _has_course(evidence: Evidence, check: str) -> bool:
    """Return whether a check has more than one frame to plot, and a value other than zero."""
    return any(
        np.isfinite(series[check]).any(axis=0).sum() > 1 and np.nanmax(np.abs(series[check])) > 0
        for series in evidence.series
        if check in series
    )


def _worst(series: Array) -> Array:
    return _clip(np.fmax.reduce(np.abs(series)))


def _clip(values: Array) -> Array:
    return np.where(np.isnan(values), np.nan, np.maximum(np.abs(values), _FLOOR))


def _curve(axes: Any, time: Array, values: Array, style: Style, place: int) -> None:
    (line,) = axes.plot(
        time,
        values,
        color=LIGHT[style.colour],
        linestyle=(0, (4, 2)) if style.dashed else "-",
        linewidth=1.6,
        marker=rf"$\mathrm{{{style.letter}}}$" if style.letter.isalnum() else None,
        markersize=8,
        markeredgewidth=0.3,
        # Shifted from curve to curve, so that coinciding curves can be told apart.
        markevery=(int(len(time) * (0.06 + 0.025 * place)) % len(time), max(1, len(time) // 4)),
    )
    # The gid becomes a class, which the page's legend uses to hide the curve.
    line.set_gid(f"curve-{place}")


def _log_axis(axes: Any, ylabel: str, *levels: float) -> None:
    axes.set(yscale="log", xlabel="time [s]", ylabel=ylabel)
    axes.margins(x=0.0)
    # It starts where most of the curves lie, not at their first frames close to zero, or just below
    # the lowest level: far above it curves would show no limit.
    curves = [line.get_ydata() for line in axes.lines if line.get_gid()]
    values = np.concatenate([*curves, np.empty(0)])
    visible = values[np.isfinite(values) & (values > _FLOOR)]
    if len(visible):
        low = 10.0 ** np.floor(np.log10(np.quantile(visible, 0.02)))
        axes.set_ylim(bottom=min((low, *(0.5 * each for each in levels))))


def _heat(axes: Any, names: list[str], shown: Array, colours: list[str]) -> None:
    logs = np.log10(np.where(shown > 0, shown, np.nan))
    image = axes.pcolormesh(logs, cmap="cividis", edgecolor="none")
    image.set_rasterized(False)
    for row, column in np.ndindex(*shown.shape):
        value = logs[row, column]
        light = image.norm(value) > 0.5 if np.isfinite(value) else None
        colour = INK if light is None else "#111111" if light else "#fafafa"
        text = "" if row == column else quantity.length(float(shown[row, column]))
        axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=8, color=colour)
    ticks = np.arange(len(shown)) + 0.5
    axes.xaxis.tick_top()
    axes.set_xticks(ticks, [name.replace(" ", "\n") for name in names], fontsize=8)
    axes.set_yticks(ticks, names, fontsize=8)
    for labels in (axes.get_xticklabels(), axes.get_yticklabels()):
        for label, colour in zip(labels, colours, strict=True):
            label.set_color(colour)
    axes.invert_yaxis()
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
