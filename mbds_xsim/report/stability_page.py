"""Stability studies as one page that needs nothing else, or as a picture of the maps."""

from __future__ import annotations

import math
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mbds_xsim.report import palette, quantity, themed
from mbds_xsim.report import stability_summary as summary
from mbds_xsim.report.stability_figures import (
    LIGHT_LOOKS,
    LOOKS,
    draw_legend,
    draw_panel,
    size_of,
    tips,
)
from mbds_xsim.report.themed import INK
from mbds_xsim.study.stability.definition import text_of
from mbds_xsim.study.stability.rows import Sweep

__all__ = ["to_html", "to_png"]

_ACROSS = 4
"""Maps side by side in a picture."""
_HEAD = 0.9
"""Height of title and legend of a picture [in]."""


def to_html(sweeps: list[Sweep]) -> str:
    """Give the page."""
    environment = Environment(
        loader=PackageLoader("mbds_xsim", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"seconds": quantity.span, "value": text_of}
    return environment.get_template("stability.html").render(
        sweeps=[_view(sweep) for sweep in sweeps],
        names=", ".join(sweep.study for sweep in sweeps),
        looks=LOOKS,
        dark_looks=set(LOOKS) - LIGHT_LOOKS,
        light=palette.LIGHT,
        dark=palette.DARK,
    )


def to_png(sweeps: list[Sweep]) -> bytes:
    """Give a picture: the maps of each study, with their legend."""
    sizes = [_picture(sweep) for sweep in sweeps]

    def draw(figure: Any) -> None:
        heights = [height for _, height in sizes]
        rows = figure.subfigures(len(sweeps), 1, squeeze=False, height_ratios=heights)
        for part, sweep in zip(rows[:, 0], sweeps, strict=True):
            _draw_study(part, sweep)

    return themed.png(draw, (max(width for width, _ in sizes), sum(h for _, h in sizes)))


def _picture(sweep: Sweep) -> tuple[float, float]:
    width, height = size_of(sweep)
    rows = math.ceil(len(sweep.panels) / _ACROSS)
    return max(width * min(_ACROSS, len(sweep.panels)), 9.0), height * rows + _HEAD


def _draw_study(figure: Any, sweep: Sweep) -> None:
    across = min(_ACROSS, len(sweep.panels))
    charts = figure.subplots(math.ceil(len(sweep.panels) / across), across, squeeze=False)
    for place, axes in enumerate(charts.flat):
        if place < len(sweep.panels):
            draw_panel(axes, sweep, place, labelled=not place % across)
        else:
            axes.set_axis_off()
    draw_legend(figure, sweep, columns=4)
    title = f"{sweep.study}: {sweep.sentence}; what breaks first within {sweep.duration_s:g} s"
    figure.suptitle(title, fontsize=11, x=0.01, ha="left", color=INK)


def _view(sweep: Sweep) -> dict[str, Any]:
    """Everything the page shows of one study."""
    told = tips(sweep)
    return {
        "s": sweep,
        "swept": summary.swept(sweep),
        "conclusion": summary.conclusion(sweep),
        "reading": summary.reading(sweep),
        "limits": [
            (panel.name, [summary.limit(panel, row) for row in range(len(sweep.values))])
            for panel in sweep.panels
        ],
        "breaking": [*summary.breaking(sweep), *summary.holding(sweep)],
        "learned": summary.learned_told(sweep),
        "seen": [outcome for outcome in LOOKS if outcome in {c.outcome for c in sweep.cells}],
        "maps": [_map(sweep, place, told) for place in range(len(sweep.panels))],
        "cells": [
            (cell, summary.what_happened(cell), dict(summary.told(cell, sweep)))
            for cell in sweep.cells
            if cell.outcome != "stable"
        ],
    }


def _map(sweep: Sweep, place: int, told: dict[str, str]) -> Markup:
    title = f"{sweep.study}: {sweep.panels[place].name}"
    return themed.svg(
        title, lambda figure: draw_panel(figure.subplots(), sweep, place), size_of(sweep), told
    )
