"""Stability studies as one page that needs nothing else, or as a picture of the maps."""

from __future__ import annotations

import math
from typing import Any

from markupsafe import Markup

from mbds_xsim.report import stability_summary as summary
from mbds_xsim.report import themed
from mbds_xsim.report.stability_figures import (
    LIGHT_LOOKS,
    LOOKS,
    charts_of,
    draw_legend,
    draw_map,
    size_of,
    tips,
)
from mbds_xsim.report.template import rendered
from mbds_xsim.report.themed import INK
from mbds_xsim.study.stability.rows import Sweep

__all__ = ["to_html", "to_png"]

_ACROSS = 4
"""Maps side by side in a picture."""
_CELL = 0.5
"""Width of a cell of the map of models in a picture [in]."""
_NARROW = 11.0
"""Width of a picture up to which the legend has three columns [in]."""
_HEAD = 0.9
"""Height of title and legend of a picture [in]."""


def to_html(sweeps: list[Sweep]) -> str:
    """Give the page."""
    return rendered(
        "stability.html",
        sweeps=[_view(sweep) for sweep in sweeps],
        names=", ".join(sweep.study for sweep in sweeps),
        looks=LOOKS,
        dark_looks=set(LOOKS) - LIGHT_LOOKS,
    )


def to_png(sweeps: list[Sweep], stored: bytes = b"") -> bytes:
    """Give a picture: the maps of each study, with their legend.

    Args:
        sweeps: What is drawn.
        stored: Of the CSV that keeps it.
    """
    sizes = [_picture(sweep) for sweep in sweeps]

    def draw(figure: Any) -> None:
        heights = [height for _, height in sizes]
        rows = figure.subfigures(len(sweeps), 1, squeeze=False, height_ratios=heights)
        for part, sweep in zip(rows[:, 0], sweeps, strict=True):
            _draw_study(part, sweep)

    size = max(width for width, _ in sizes), sum(height for _, height in sizes)
    return themed.png(draw, size, stored)


def _picture(sweep: Sweep) -> tuple[float, float]:
    _, engines, models = _parted(sweep)
    width, height = size_of(sweep)
    rows = math.ceil(len(engines) / _ACROSS)
    below = size_of(sweep, models) if models else (0.0, 0.0)
    wide = max(width * min(_ACROSS, len(engines)), below[0], 9.0)
    return wide, height * rows + below[1] + _HEAD


def _parted(sweep: Sweep) -> tuple[int, list[tuple[int, ...]], tuple[int, ...]]:
    """Give how many maps stand side by side, those of engines, and the places of models."""
    charts = charts_of(sweep)
    models = next((places for places in charts if sweep.panels[places[0]].learned), ())
    engines = [places for places in charts if places != models]
    return min(_ACROSS, len(engines)), engines, models


def _draw_study(figure: Any, sweep: Sweep) -> None:
    across, engines, models = _parted(sweep)
    rows = math.ceil(len(engines) / _ACROSS)
    grid = figure.add_gridspec(rows + bool(models), max(across, 1))
    for k, places in enumerate(engines):
        axes = figure.add_subplot(grid[k // across, k % across])
        draw_map(axes, sweep, places, labelled=not k % across)
    if models:
        room = round(_picture(sweep)[0] / _CELL)
        draw_map(figure.add_subplot(grid[-1, :]), sweep, models, columns=room)
    draw_legend(figure, sweep, columns=4 if _picture(sweep)[0] > _NARROW else 3)
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
        "maps": [_map(sweep, places, told) for places in charts_of(sweep)],
        "cells": [
            (cell, summary.what_happened(cell), dict(summary.told(cell, sweep)))
            for cell in sweep.cells
            if cell.outcome != "stable"
        ],
    }


def _map(sweep: Sweep, places: tuple[int, ...], told: dict[str, str]) -> Markup:
    title = f"{sweep.study}: {', '.join(sweep.panels[place].name for place in places)}"
    return themed.svg(
        title,
        lambda figure: draw_map(figure.subplots(), sweep, places),
        size_of(sweep, places),
        told,
    )
