"""Empty charts are not drawn: no empty axes, no panel without a line."""

from __future__ import annotations

import dataclasses
import math
import struct

import msgspec
import numpy as np
import pytest

from mbds_xsim.learn.curves import LearningCurve, to_png
from mbds_xsim.learn.train import CurvePoint
from mbds_xsim.measure.result import Validation
from mbds_xsim.report.themed import svg
from mbds_xsim.studies.tradeoff import Point
from mbds_xsim.studies.tradeoff.figures import charts_of
from mbds_xsim.studies.validate.figures import (
    check_series,
    consistency,
    plotted_checks,
    restitution,
)
from tests.results import curve, tradeoff

from .conftest import Case


@pytest.mark.parametrize("figure", ["error_m", "error_weighted_m", "energy", "gap_m"])
def test_a_tradeoff_has_a_chart_only_of_what_some_point_has(figure: str) -> None:
    at = {"steps_per_frame": 1, "step_s": 0.02, "kind": "done", "wall_s": 0.1}
    point = Point(**at, **{figure: 1e-3})  # type: ignore[arg-type]

    charts = charts_of(tradeoff(curve("mujoco", "RK4", point)))

    assert {chart.y for chart in charts} == {figure}


def test_a_tradeoff_without_gaps_or_points_has_no_such_chart() -> None:
    exact = Point(steps_per_frame=1, step_s=0.02, kind="done", wall_s=0.1, error_m=1e-3, gap_m=0.0)
    too_slow = Point(steps_per_frame=1, step_s=0.02, kind="too slow")

    assert {c.y for c in charts_of(tradeoff(curve("mujoco", "RK4", exact)))} == {"error_m"}
    assert charts_of(tradeoff(curve("mujoco", "RK4", too_slow))) == []


def test_a_page_plots_no_check_that_is_zero_or_known_at_one_frame_alone(case: Case) -> None:
    shape = case.evidence.series[0]["momentum"].shape
    once = np.full(shape, math.nan)
    once[:, -1] = 1.0
    series = {"momentum": np.full(shape, 1e-12), "gap rate": np.zeros(shape), "start": once}
    evidence = dataclasses.replace(case.evidence, series=(series,))

    assert plotted_checks(evidence) == ["momentum"]


def test_a_check_that_is_infinite_but_for_a_few_frames_is_plotted(case: Case) -> None:
    lost = np.full(case.evidence.series[0]["momentum"].shape, 1e-9)
    lost[:, 2:] = math.inf
    count = len(case.evidence.series)
    evidence = dataclasses.replace(case.evidence, series=({"momentum": lost},) * count)

    figure = check_series(case.validation, evidence, "momentum")

    assert svg("", figure.draw, figure.size, figure.tips).startswith("<svg")


@pytest.mark.parametrize("budget", [1e-2, 1e-12])
def test_a_check_that_is_far_over_its_budget_is_plotted_with_it(case: Case, budget: float) -> None:
    from matplotlib.figure import Figure

    far, count = np.full_like(case.evidence.series[0]["gap"], 0.5), len(case.evidence.series)
    evidence = dataclasses.replace(case.evidence, series=({"gap": far},) * count)
    figure = check_series(_with_budget(case.validation, "gap", budget), evidence, "gap")
    picture = Figure(figure.size, layout="constrained")

    figure.draw(picture)
    picture.draw_without_rendering()  # which warns if a label outside leaves no room for the axes

    (axes,) = picture.axes
    assert axes.get_ylim()[0] < budget < axes.get_ylim()[1]
    assert axes.get_position().height > 0.5


def _with_budget(validation: Validation, check: str, budget: float) -> Validation:
    replace = msgspec.structs.replace
    engines = (
        replace(
            engine,
            findings=tuple(
                replace(finding, budget=budget) if finding.check == check else finding
                for finding in engine.findings
            ),
        )
        for engine in validation.engines
    )
    return replace(validation, engines=tuple(engines))


def test_a_page_has_no_figures_of_checks_that_nothing_was_held_to(case: Case) -> None:
    replace = msgspec.structs.replace
    engines = tuple(replace(engine, findings=()) for engine in case.validation.engines)
    bare = replace(case.validation, engines=engines)

    assert consistency(case.validation) is not None
    assert consistency(bare) is None
    assert restitution(case.validation, case.evidence, (None,) * 9) is None


def test_a_training_that_diverged_at_once_gets_no_panel() -> None:
    def trained(model: str, error: float) -> LearningCurve:
        points = [CurvePoint(step, 1.0, error, 1e-3) for step in (10, 20)]
        return LearningCurve(f"2pendulum/native/{model}/mujoco-s0", 20, "steps", points)

    sound, other, lost = trained("gns", 0.1), trained("sgnn", 0.2), trained("hgnn", math.inf)

    assert _width(to_png([sound, lost])) == _width(to_png([sound])) < _width(to_png([sound, other]))


def _width(png: bytes) -> int:
    """Return the width [pixel] in the header of a PNG."""
    return int(struct.unpack(">I", png[16:20])[0])
