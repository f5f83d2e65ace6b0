"""Trade-off studies as one page that needs nothing else, or as a picture of the charts."""

from __future__ import annotations

import textwrap
from typing import Any

from markupsafe import Markup

from mbds_xsim.report import themed
from mbds_xsim.report import tradeoff_summary as summary
from mbds_xsim.report.learned_summary import model_columns, models_told
from mbds_xsim.report.template import rendered
from mbds_xsim.report.themed import INK, PAPER
from mbds_xsim.report.tradeoff_figures import (
    PANELS,
    Panel,
    colour_of,
    draw_panel,
    legend_entries,
    tips,
)
from mbds_xsim.safe_text import in_figure
from mbds_xsim.study.rows import Tradeoff

__all__ = ["to_html", "to_png"]

_MAIN, _SMALL = (7.6, 4.6), (5.4, 3.7)
_PICTURE = (14.0, 5.4)
_MOST_LINES = 7
_LONGEST = 165


def to_html(studies: list[Tradeoff]) -> str:
    """Give the page."""
    return rendered(
        "tradeoff.html",
        studies=[_view(study) for study in studies],
        names=", ".join(study.scene for study in studies),
    )


def to_png(studies: list[Tradeoff], stored: bytes = b"") -> bytes:
    """Give a picture: a row of two charts for each study, failures under them.

    Args:
        studies: What is drawn.
        stored: Of the JSON that keeps it.
    """
    width, height = _PICTURE

    def draw(figure: Any) -> None:
        rows = figure.subfigures(len(studies), 1, squeeze=False)
        for row, study in zip(rows[:, 0], studies, strict=True):
            _draw_row(row, study)

    return themed.png(draw, (width, height * len(studies)), stored)


def _draw_row(figure: Any, study: Tradeoff) -> None:
    charts = figure.subplots(1, 2)
    panels = _panels(study)
    for axes, panel in zip(charts, (*panels, None, None), strict=False):
        if panel is None:
            axes.set_axis_off()
        else:
            draw_panel(axes, study, panel)
    handles = [
        charts[0].plot([], [], marker, color=colour, label=label, ls="-")[0]
        for label, colour, marker in legend_entries(study)
    ]
    star = {"color": PAPER, "markeredgecolor": INK, "ms": 9, "label": "native settings"}
    handles += charts[0].plot([], [], "*", **star)
    figure.legend(handles=handles, loc="outside right upper", frameon=False, fontsize=8)
    figure.suptitle(
        f"{in_figure(study.scene)}: speed against accuracy", fontsize=12, x=0.01, ha="left"
    )
    figure.supxlabel("\n".join(_footnotes(study)), fontsize=7.5, x=0.01, ha="left", color=INK)


def _panels(study: Tradeoff) -> list[Panel]:
    """Charts that have anything to show."""
    return [
        panel
        for panel in PANELS
        if any(
            panel.x(point) is not None and (panel.y(point) or 0.0) > panel.floor(study)
            for curve in study.curves
            for point in curve.points
        )
    ]


def _footnotes(study: Tradeoff) -> list[str]:
    lines = textwrap.wrap(summary.what_is_charted(study), _LONGEST)
    if study.models:
        lines += textwrap.wrap(f"Trained models {models_told(study)}", _LONGEST)
    failed = [f"{name}: {steps}: {what}" for name, steps, what in summary.failures(study)]
    lines += failed[:_MOST_LINES]
    if len(failed) > _MOST_LINES:
        lines.append(f"and {len(failed) - _MOST_LINES} more failures, listed by --html and --json")
    return [line if len(line) < _LONGEST else f"{line[:_LONGEST]} …" for line in lines]


def _view(study: Tradeoff) -> dict[str, Any]:
    """Everything the page shows of one study."""
    told = tips(study)
    return {
        "s": study,
        "conclusion": summary.conclusion(study),
        "machine": summary.machine_told(study),
        "charted": summary.what_is_charted(study),
        "columns": summary.columns(study),
        "curves": summary.main_curves(study),
        "failures": summary.failures(study),
        "options": summary.options_that_pay(study),
        "model_columns": model_columns(study),
        "models_told": models_told(study),
        "legend": [
            {"place": place, "name": curve.name, "colour": colour_of(curve.engine)}
            for place, curve in enumerate(study.curves)
        ],
        "charts": [
            (panel.title(study), _chart(study, panel, told, main=not k), not k)
            for k, panel in enumerate(_panels(study))
        ],
    }


def _chart(study: Tradeoff, panel: Panel, told: dict[str, str], *, main: bool) -> Markup:
    def draw(figure: Any) -> None:
        axes = figure.subplots()
        draw_panel(axes, study, panel)
        if main:
            for label, colour, marker in legend_entries(study):
                axes.plot([], [], marker, color=colour, label=label, ls="-")
            figure.legend(loc="outside right upper", frameon=False, fontsize=8)

    return themed.svg(panel.title(study), draw, _MAIN if main else _SMALL, told)
