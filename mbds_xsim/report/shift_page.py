"""Shift studies as one page that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.shift.samples import Samples, samples_of
from mbds_xsim.learn.shift.study import Studied
from mbds_xsim.report import themed
from mbds_xsim.report.shift_figures import curves_of, draw_curves, draw_matrix, map_size, spread_of
from mbds_xsim.report.shift_markdown import protocol, time_told
from mbds_xsim.report.shift_matrix import at, matrix_of, trained_models
from mbds_xsim.report.shift_motion import draw_samples, name_of, pack, picture_size, styles_of
from mbds_xsim.report.shift_tables import tables
from mbds_xsim.report.template import rendered

__all__ = ["to_html"]

_CURVES = (6.6, 3.4)


def to_html(studies: Sequence[Studied]) -> str:
    """Give the page."""
    samples = [samples_of(studied.board) for studied in studies]
    return rendered(
        "shift.html",
        studies=[_view(each.shift, some) for each, some in zip(studies, samples, strict=True)],
        # The page has one viewer, so only a scene of its own has one.
        viewer=pack(samples[0]) if len(studies) == 1 else None,
        styles=list(zip(map(name_of, samples[0].models), styles_of(samples[0]), strict=True)),
        names=", ".join(studied.shift.scene for studied in studies),
    )


def _view(shift: Shift, samples: Samples) -> dict[str, Any]:
    return {
        "s": shift,
        "protocol": protocol(shift),
        "time": time_told(shift),
        "tables": list(tables(shift)),
        "maps": [(frame, _maps(shift, frame), frame == shift.at) for frame in shift.frames],
        "picture": _picture(samples),
        "domain": samples.domain.name,
        "curves": [(model, _curves(shift, model)) for model in trained_models(shift)],
    }


def _maps(shift: Shift, frame: int) -> list[Markup]:
    """A heat map a model, on one scale of colours."""
    every = [matrix_of(shift, model, at(shift, frame)) for model in trained_models(shift)]
    matrices = [matrix for matrix in every if matrix.has_figures]
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


def _picture(samples: Samples) -> Markup:
    def draw(figure: Any) -> None:
        draw_samples(figure, samples)

    return themed.svg("rollouts over the truth", draw, picture_size(samples), {})


def _curves(shift: Shift, model: str) -> list[Markup]:
    """Errors over time on all engines' domains."""
    tests = [domain.name for domain in shift.domains if curves_of(shift, model, domain.name)]
    drawn = []
    for test in tests:

        def draw(figure: Any, test: str = test) -> None:
            draw_curves(figure.subplots(), shift, model, test)
            figure.legend(loc="outside right upper", fontsize=7, frameon=False)

        drawn.append(themed.svg(f"{model} on {test}: error over time", draw, _CURVES, {}))
    return drawn
