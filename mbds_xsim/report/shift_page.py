"""Shift studies as one page that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.shift.study import Studied
from mbds_xsim.report import palette, themed
from mbds_xsim.report.shift_figures import draw_curves, draw_matrix, map_size, spread_of
from mbds_xsim.report.shift_markdown import protocol
from mbds_xsim.report.shift_tables import at, headline, matrix_of, tables, trained_models

__all__ = ["to_html"]

_CURVES = (6.0, 3.8)


def to_html(studies: Sequence[Studied]) -> str:
    """Give the page."""
    environment = Environment(
        loader=PackageLoader("mbds_xsim", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("shift.html").render(
        studies=[_view(studied.shift) for studied in studies],
        names=", ".join(studied.shift.scene for studied in studies),
        light=palette.LIGHT,
        dark=palette.DARK,
    )


def _view(shift: Shift) -> dict[str, Any]:
    return {
        "s": shift,
        "protocol": protocol(shift),
        "tables": list(tables(shift)),
        "maps": [(frame, _maps(shift, frame), frame == headline(shift)) for frame in shift.frames],
        "curves": [_curves(shift, model) for model in trained_models(shift)],
    }


def _maps(shift: Shift, frame: int) -> list[Markup]:
    """A heat map a model, on one scale of colours."""
    matrices = [matrix_of(shift, model, at(shift, frame)) for model in trained_models(shift)]
    spread = spread_of(matrices)
    drawn = []
    for matrix in matrices:
        title = f"{matrix.model}, t = {frame}"

        def draw(figure: Any, matrix: Any = matrix, title: str = title) -> None:
            axes = figure.subplots()
            draw_matrix(axes, matrix, spread)
            axes.set_title(title, fontsize=10, loc="left")

        drawn.append(themed.svg(title, draw, map_size(matrix), {}))
    return drawn


def _curves(shift: Shift, model: str) -> Markup:
    """Errors over time on the first domain of each variant."""
    tests = list({d.variant: d.name for d in reversed(shift.domains) if d.variant}.values())

    def draw(figure: Any) -> None:
        charts = figure.subplots(1, len(tests), squeeze=False)[0]
        for axes, test in zip(charts, tests, strict=True):
            draw_curves(axes, shift, model, test)
            axes.legend(fontsize=6.5, frameon=False, loc="lower right", ncols=2)

    size = (_CURVES[0] * len(tests), _CURVES[1])
    return themed.svg(f"{model}: error over time", draw, size, {})
