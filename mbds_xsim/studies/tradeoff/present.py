"""A trade-off study as a report, and as a picture of its charts."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from functools import partial
from typing import Any

from mbds_xsim.base.text import counted, in_figure, sentence
from mbds_xsim.report import blocks, quantity, themed
from mbds_xsim.report.themed import INK, PAPER
from mbds_xsim.studies.tradeoff import BATCH, Point, Tradeoff, figures, words

_USUAL = ("", BATCH)
_MAIN, _SMALL = (7.6, 4.6), (5.4, 3.7)
_PICTURE = (14.0, 5.4)
_MOST_LINES = 7
_LONGEST = 165
_READING = (
    "Colour is the engine, marker the method; small hollow marks have one option changed, large "
    "hollow ones are shares of a batch, stars are native settings. The grey band joins the points "
    "that no other beats in both speed and accuracy. Bars show the fastest and the slowest repeat. "
    "Point at a mark for its figures"
)
_POINTS = (
    "settings", ">step", ">cost", ">spread", ">processor", ">set-up", ">error", ">all times",
    ">gap", ">energy", "over budget",
)  # fmt: skip


def present(study: Tradeoff) -> blocks.Report:
    """Build the report of a study: its conclusion, with the tables and charts that support it."""
    versions = ", ".join(f"{name} {version}" for name, version in study.versions.items())
    rows = f"{counted(study.measured, 'row')} measured, {study.kept} kept from earlier"
    return blocks.Report(
        title=study.scene,
        what="speed against accuracy",
        description=study.description,
        conclusion=f"{sentence(words.models_short(study))}{sentence(words.conclusion(study))}".rstrip(),
        blocks=tuple(_blocks(study)),
        command=study.command,
        made=f"{words.machine_line(study)}; {rows}, in {quantity.span(study.wall_s)}; {versions}",
    )


def _blocks(study: Tradeoff) -> Iterator[blocks.Block]:
    yield words.main_table(study)
    if study.models:
        yield words.models_table(study)
        yield blocks.Remarks.of([("trained models", words.describe_models(study))])
    yield blocks.Remarks.of(
        [
            ("error", words.describe_error(study)),
            *(("option that pays", line) for line in words.options_that_pay(study)),
        ]
    )
    yield blocks.Section("Charts", tuple(_charts(study)), on=blocks.PAGE)
    failed = words.failures(study)
    if failed or study.left_out:
        lines = [blocks.Remark(name, f"{steps}: {cause}", "fail") for name, steps, cause in failed]
        lines += [blocks.Remark("left out", reason) for reason in study.left_out.values()]
        yield blocks.Section("Failures", (blocks.Remarks(tuple(lines), _MOST_LINES + 1),))
    points = blocks.table_of(_POINTS, _point_rows(study))
    yield blocks.Section("All points", (points,), folded=True, on=blocks.PAGE)


def _charts(study: Tradeoff) -> Iterator[blocks.Block]:
    yield blocks.Text(_READING)
    keys = [
        (curve.variation, blocks.Key(curve.name, figures.colour_of(curve.engine), curve=str(place)))
        for place, curve in enumerate(study.curves)
    ]
    models = [blocks.Key("trained models", "", curve="model")] if study.models else []
    yield blocks.Legend((*(key for varied, key in keys if varied in _USUAL), *models))
    changed = tuple(key for varied, key in keys if varied not in _USUAL)
    if changed:
        yield blocks.Section(
            "changed options and native settings", (blocks.Legend(changed),), folded=True
        )
    notes, charts = figures.tips(study), enumerate(figures.charts_of(study))
    shown = tuple(_figure(chart, notes, main=not k) for k, chart in charts)
    yield blocks.FigureGroup(shown, least=480)


def _figure(chart: figures.Chart, notes: dict[str, str], *, main: bool) -> blocks.Figure:
    def draw(axes: Any) -> None:
        figures.draw_chart(axes, chart)
        if main:
            _legend(axes, chart.study)

    return blocks.chart(chart.title, draw, _MAIN if main else _SMALL, tips=notes, wide=main)


def _legend(axes: Any, study: Tradeoff, **star: Any) -> None:
    """Explain the curves beside the axes, and `star`, the look of a further mark, if any."""
    for label, colour, marker in figures.legend_entries(study):
        axes.plot([], [], marker, color=colour, label=label, ls="-")
    if star:
        axes.plot([], [], "*", **star)
    axes.figure.legend(loc="outside right upper", frameon=False, fontsize=8)


def _point_rows(study: Tradeoff) -> Iterator[blocks.Row]:
    for curve in study.curves:
        for point in curve.points:
            texts = (curve.name, quantity.pace(point.step_s, point.rtol), *_figures(point))
            mark: blocks.Mark = "strong" if point.on_front else ""
            tone: blocks.Mark = mark if mark or point.kind == "done" else "muted"
            yield blocks.row_of((blocks.Cell(text, mark) for text in texts), tone)


def _figures(point: Point) -> Iterator[str]:
    if point.kind != "done":
        yield from ("",) * (len(_POINTS) - 3)
        yield f"{point.kind}: {point.reason}"
        return
    yield quantity.span(point.wall_s)
    yield f"{quantity.span(point.wall_low_s)} – {quantity.span(point.wall_high_s)}"
    yield from map(quantity.span, (point.cpu_s, point.setup_s))
    yield from map(quantity.length, (point.error_m, point.error_weighted_m, point.gap_m))
    yield quantity.number(point.energy)
    yield ", ".join(point.broken)


def to_png(studies: list[Tradeoff], stored: bytes = b"") -> bytes:
    """Draw a PNG picture: a row of two charts for each study, with failures below.

    `stored` is the JSON file of the studies.
    """
    return themed.stacked(
        [(partial(_draw_row, study=study), _PICTURE) for study in studies], stored
    )


def _draw_row(figure: Any, study: Tradeoff) -> None:
    charts = figure.subplots(1, 2)
    for axes, chart in zip(charts, (*figures.charts_of(study), None, None), strict=False):
        if chart is None:
            axes.set_axis_off()
        else:
            figures.draw_chart(axes, chart)
    _legend(charts[0], study, color=PAPER, mec=INK, ms=9, label="native settings")
    figure.suptitle(
        f"{in_figure(study.scene)}: speed against accuracy", fontsize=12, x=0.01, ha="left"
    )
    figure.supxlabel("\n".join(_footnotes(study)), fontsize=7.5, x=0.01, ha="left", color=INK)


def _footnotes(study: Tradeoff) -> list[str]:
    lines = textwrap.wrap(words.describe_error(study), _LONGEST)
    if study.models:
        lines += textwrap.wrap(f"Trained models {words.describe_models(study)}", _LONGEST)
    failed = [f"{name}: {steps}: {cause}" for name, steps, cause in words.failures(study)]
    lines += failed[:_MOST_LINES]
    if len(failed) > _MOST_LINES:
        lines.append(f"and {len(failed) - _MOST_LINES} more failures, listed by --html and --json")
    return [line if len(line) < _LONGEST else f"{line[:_LONGEST]} …" for line in lines]
