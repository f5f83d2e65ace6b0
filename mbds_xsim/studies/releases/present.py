"""The history of an engine as a report, and its picture."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import groupby
from typing import Any

import numpy as np

from mbds_xsim.base.text import counted
from mbds_xsim.report import blocks, quantity, themed
from mbds_xsim.report.themed import GREY, INK
from mbds_xsim.studies.releases.steps import FACTOR, UNITS, History, Step, comparable

_MOST = 40
"""Largest number of steps that a terminal shows."""
_KINDS = {
    "error": "Error",
    "order": "Order",
    "gap": "Gaps of joints",
    "energy": "Energy from nowhere, or lost",
    "restitution": "Restitution",
    "time": "Processor time per simulated second",
}
_DECADES = 3.0
"""Range of the colours, in decades above the best."""
_CELL, _LINE, _LEFT, _HEAD = 0.27, 0.16, 3.2, 1.5  # [in]


def present(history: History) -> blocks.Report:
    """Report what changed between releases."""
    return blocks.Report(
        title=f"{history.engine}, release by release",
        what="newest release is worse" if history.verdict == "fail" else "nothing new is worse",
        conclusion=_conclusion(history),
        description=_DESCRIPTION,
        blocks=tuple(_blocks(history)),
        command=history.command,
        made=f"{history.machine}, {counted(history.measured, 'row')} measured, {history.kept} kept "
        f"from earlier, in {quantity.span(history.wall_s)}; "
        + ", ".join(f"{name} {version}" for name, version in history.versions.items()),
        verdict=history.verdict,
    )


_DESCRIPTION = (
    "Each release runs in processes of its own, at the same settings: the ladder of small cases "
    "with exact answers, a start of each of the paper's scenes, a ball's rebound. A step is a "
    f"figure that differs by more than a factor of {FACTOR:g} from the release before, or an order "
    "that differs by more than a half; for restitution it is the distance from what was asked."
)


def _conclusion(history: History) -> str:
    steps = [step for step in history.steps if step.what != "time"]
    unexplained = sum(step.unexplained for step in steps)
    rows = len({step.name for step in steps})
    newest, regressions = history.releases[-1], len(history.regressions)
    worse = counted(regressions, "figure is", "figures are") if regressions else "nothing is"
    state = "it is not driven" if newest.reason else f"{worse} worse without an explanation"
    return (
        f"{len(history.driven)} of {counted(len(history.releases), 'release')} driven; "
        f"{counted(len(steps), 'step')} in {rows} of {counted(len(history.names), 'row')}, "
        f"{unexplained} of them unexplained, times apart; of {newest.version}, the newest, {state}"
    )


def _blocks(history: History) -> Iterator[blocks.Block]:
    yield _steps(history)
    yield blocks.Remarks.of(_remarks(history))
    if _stepping(history):
        figure = blocks.Figure(
            _title(history), lambda f: draw(f, history), size_of(history), wide=True
        )
        yield blocks.Section("At a glance", (blocks.FigureGroup((figure,)),), on=blocks.PAGE)
    tables = tuple(filter(None, (_figures(history, kind) for kind in _KINDS)))
    yield blocks.Section("All figures", tables, folded=True, on=blocks.PAGE)


def _steps(history: History) -> blocks.Table:
    why = blocks.Column("why", "What the change log says, and what the engine did.", words=True)
    headings = ("release", "case and method or settings", "figure", ">before", ">now", ">factor")
    rows = (_step(step) for step in history.steps if step.what != "time")
    return blocks.table_of((*headings, why), rows, title="Steps", most=_MOST, grouped=True)


def _step(step: Step) -> blocks.Row:
    courses = {"lost": ("runs", "lost"), "runs": ("lost", "runs")}
    texts = (_written(step.what, value, step.unit) for value in (step.old, step.new))
    before, now = courses.get(step.course) or texts
    factor = quantity.NONE if step.factor is None else f"{quantity.number(step.factor)}×"
    reason = f"before: {step.reason}" if step.course == "runs" else step.reason
    explanation = "unexplained" if step.unexplained else step.explanation
    mark: blocks.Mark = "over" if step.worse else ""
    remark = "; ".join(filter(None, (explanation, reason)))
    cells = (step.release, step.name, step.what, before, now, factor, remark)
    return blocks.row_of(cells, mark)


def _written(kind: str, value: float | None, unit: str) -> str:
    if kind in ("order", "restitution") and value is not None:
        return f"{value:.2f}"
    return quantity.with_unit(value, unit)


def _remarks(history: History) -> Iterator[tuple[str, str]]:
    for release in history.releases:
        if release.reason:
            yield f"{release.version} is not driven", release.reason
    for version in history.driven:
        failed = (row for row in history.rows if row.release == version and row.kind != "done")
        reasons = Counter(row.reason for row in failed)
        texts = (f"{reason} ({counted(count, 'row')})" for reason, count in reasons.items())
        if reasons:
            yield f"{version} does not do all", "; ".join(texts)
    times = [step for step in history.steps if step.what == "time"]
    for version, steps in groupby(times, lambda step: step.release):
        texts = (f"{step.name} {quantity.number(step.factor)}×" for step in steps)
        yield f"{version} takes another time", ", ".join(texts)
    if history.change_log:
        yield "change log", history.change_log


def _figures(history: History, kind: str) -> blocks.Table | None:
    """Lay out one figure of all rows over all releases."""
    columns = ("case", *(f">{version}" for version in history.driven))
    rows = []
    for name in history.names:
        texts = [_written(kind, value, UNITS[kind]) for value in history.series(name, kind)]
        if any(text != quantity.NONE for text in texts):
            rows.append([name, *texts])
    return blocks.table_of(columns, rows, title=_KINDS[kind]) if rows else None


def to_png(histories: list[History], stored: bytes = b"") -> bytes:
    """Draw a PNG picture of all engines, one below the other; `stored` is their JSON file."""
    parts = [(partial(draw, history=each), size_of(each)) for each in histories]
    return themed.stacked(parts, stored)


def size_of(history: History) -> tuple[float, float]:
    """Return width and height of a picture [in]."""
    wide = _LEFT + _CELL * max(len(history.driven), 8) + 1.0
    return wide, _HEAD + _LINE * max(len(_stepping(history)), 4)


def _stepping(history: History) -> list[tuple[str, str]]:
    """List the rows and figures that have a step, by kind of figure; times are left out."""
    shown = (
        (s.name, _telling(history, s.name) if s.what == "motion" else s.what) for s in history.steps
    )
    pairs = {(name, kind) for name, kind in shown if kind != "time"}
    order = {name: place for place, name in enumerate(history.names)}
    kinds = list(_KINDS)
    return sorted(pairs, key=lambda pair: (kinds.index(pair[1]), order[pair[0]]))


def _telling(history: History, name: str) -> str:
    """Return the first kind of figure that a row has in any release."""
    shown = (kind for kind in _KINDS if set(history.series(name, kind)) != {None})
    return next(shown, "error")


def _title(history: History) -> str:
    return (
        f"{history.engine}: figures that changed by more than a factor of {FACTOR:g}, by release "
        "(grey: not run)"
    )


def draw(figure: Any, history: History) -> None:
    """Draw figures that have a step over the releases, in decades above each one's best."""
    pairs, versions = _stepping(history), history.driven
    values = np.full((max(len(pairs), 1), len(versions)), np.nan)
    for y, (name, kind) in enumerate(pairs):
        for x, value in enumerate(history.series(name, kind)):
            if value is not None:
                values[y, x] = math.log10(max(comparable(kind, value), 1e-12))
    values -= np.fmin.reduce(values, axis=1, keepdims=True)
    axes = figure.subplots()
    axes.grid(visible=False)
    axes.set_facecolor(GREY)
    image = axes.imshow(values, aspect="auto", cmap="YlOrRd", vmin=0.0, vmax=_DECADES)
    axes.set_xticks(range(len(versions)), versions, rotation=90, fontsize=7)
    axes.set_yticks(range(len(pairs)), [f"{kind}: {name}" for name, kind in pairs], fontsize=7)
    bar = figure.colorbar(image, ax=axes, ticks=range(int(_DECADES) + 1), shrink=0.9, pad=0.01)
    bar.ax.set_yticklabels(["best", *(f"{10**n}×" for n in range(1, int(_DECADES) + 1))])
    figure.suptitle(_title(history), fontsize=10, x=0.01, ha="left", color=INK)
