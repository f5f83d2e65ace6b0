"""A trade-off: orders as declared, error and times of a point, and the steps that are tried."""

from __future__ import annotations

import math
import statistics
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.isolate import HERE
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate import registry, timed
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.claims import features_of
from mbds_xsim.simulate.simulator import NATIVE, EngineMethod
from mbds_xsim.studies.tradeoff import Measurement, bench, curves_of
from mbds_xsim.studies.tradeoff import study as study_module
from mbds_xsim.studies.tradeoff.study import rollout_cost, tradeoff_with_rows
from tests.study.tradeoffs import ROW, curve_of, studied

pytestmark = pytest.mark.usefixtures("few_steps")


def test_measured_orders_are_those_declared(scene: Scene) -> None:
    study = studied(scene)

    for name in ("mujoco RK4", "mujoco Euler", "exudyn trapezoidal", "exudyn generalised-alpha"):
        curve = curve_of(study, name)
        assert curve.measured_order == pytest.approx(curve.order, abs=0.25), name
    assert {point.kind for curve in study.curves for point in curve.points} == {"done"}


def test_the_error_is_at_the_end_of_a_scene_shorter_than_a_second(scene: Scene) -> None:
    study = studied(scene, "mujoco")

    assert study.horizon_s == pytest.approx(0.4)
    first = curve_of(study, "mujoco Euler").points[0]
    assert 0.0 < first.error_m <= 10.0 * first.error_weighted_m


def test_times_are_the_median_of_starts_and_repeats(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timed, "_ENOUGH", math.inf)
    monkeypatch.setattr(timed, "_MOST_REPEATS", 3)
    study, rows = tradeoff_with_rows(scene, choice=Choice.parse(engines="mujoco"), conduct=HERE)

    first = curve_of(study, "mujoco RK4").points[0]
    own = [r for r in rows if (r.method, r.variation) == ("RK4", "")]
    own = [row for row in own if row.steps_per_frame == first.steps_per_frame]
    assert [row.trajectory for row in own] == [1, 4, 7]
    assert [len(row.wall_s) for row in own] == [3, 3, 3]
    medians = [statistics.median(row.wall_s) for row in own]
    assert first.wall_s == pytest.approx(statistics.median(medians))
    assert first.wall_low_s <= first.wall_s <= first.wall_high_s


def test_what_would_take_too_long_is_listed(scene: Scene) -> None:
    choice = Choice.parse(engines="mujoco")
    study = tradeoff_with_rows(scene, choice=choice, starts=1, limit=1e-6, conduct=HERE)[0]

    curve = curve_of(study, "mujoco RK4")
    assert [point.kind for point in curve.points] == ["done", *["too slow"] * 5]
    assert "limit 1e-06 s" in curve.points[1].reason
    assert "predicted 0 s" not in curve.points[1].reason


def test_a_predicted_time_of_minutes_is_in_whole_seconds(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.study.rollout_cost", lambda *_: 1234.4)
    choice = Choice.parse(engines="mujoco")
    study = tradeoff_with_rows(scene, choice=choice, starts=1, conduct=HERE)[0]

    assert "predicted 1234 s a start" in curve_of(study, "mujoco RK4").points[-1].reason


def test_steps_go_on_until_the_budget_is_kept_tenfold(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.COUNTS", (1, 2, 4, 8, 16, 32))
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.study.SPAN", 4)
    budget = scene.budget.error_1s * scene.length

    study = studied(scene, "mujoco")

    precise = curve_of(study, "mujoco RK4").points
    coarse = curve_of(study, "mujoco Euler").points
    assert [point.steps_per_frame for point in precise] == [1, 2, 4]
    assert len(coarse) > 3
    assert all(point.error_m > 0.1 * budget for point in coarse[2:-1])


@pytest.mark.parametrize(
    ("kind", "error_m", "following"),
    [
        ("failed", None, 200),
        ("crashed", None, 200),
        ("done", 0.5, 200),
        ("done", 1e-9, None),
        ("done", None, None),  # without a reference
        ("too slow", None, None),
    ],
)
def test_steps_go_on_where_a_hundred_a_frame_are_not_enough(
    scene: Scene, kind: Any, error_m: float | None, following: int | None
) -> None:
    curve = EngineMethod("mujoco", "RK4", own_options={}, counts=(100, 200))
    row = msgspec.structs.replace(ROW, kind=kind, error_m=error_m)
    known = reference.solve(scene, draw_batch(scene, [1]))
    truth = bench.Truth(known, np.ones((1, 21)))
    workbench = bench.StartBench(scene, draw_batch(scene, [1]), [truth], 0, 30.0, HERE)

    assert study_module._next_count(workbench, curve, [row]) == following


def test_with_frames_above_a_second_the_error_is_at_the_first() -> None:
    slow = msgspec.structs.replace(
        registry.load_scene("2pendulum"), clock=Clock(1.25, 2), gravity=(0.0, 0.0, -0.05)
    )

    study = studied(slow, "mujoco")

    assert (study.horizon_s, study.own_limit) == (1.25, None)
    assert all(point.error_m for point in curve_of(study, "mujoco RK4").points)


def test_a_run_below_the_resolution_of_the_clock_predicts_nothing() -> None:
    def row(count: int, *cpu_s: float) -> Measurement:
        return Measurement(
            key="", scene="", engine="", version="", method="", variation="", options={},
            steps_per_frame=count, step_s=0.02 / count, trajectory=0, seed=0, machine="",
            limit_s=60.0, kind="done", cpu_s=cpu_s,
        )  # fmt: skip

    assert rollout_cost([row(1, 0.0), row(2)], 4, 3.0) is None
    assert rollout_cost([row(1, 0.0), row(2, 0.1)], 4, 3.0) == pytest.approx(0.6)
    assert rollout_cost([row(1, 0.05), row(2, 0.1)], 4, 3.0) == pytest.approx(0.6)


def test_sweeps_name_options_and_methods_of_the_engine(adapter: Adapter) -> None:
    for option, tried in adapter.sweeps.items():
        usual = adapter.options[option].default
        assert set(tried.methods) <= set(adapter.methods)
        assert all(isinstance(value, str) == isinstance(usual, str) for value in tried.values)
        assert len(set(tried.values)) == len(tried.values) > 1


@pytest.mark.parametrize("name", ["1ladder", "balldrop"])
def test_what_is_tried_can_be_loaded(adapter: Adapter, name: str) -> None:
    scene = registry.load_scene(name)

    curves, _ = curves_of(scene, [adapter.name])

    if all(adapter.refusals(scene, method) for method in adapter.methods):
        assert curves == []
        return
    varied = [curve for curve in curves if curve.variation not in ("", NATIVE)]
    for curve in varied:
        adapter.check(scene, curve.settings(scene, 5))
        assert _needs_met(adapter, curve, scene)
    assert bool(varied) == bool(adapter.sweeps)
    assert len({curve.name for curve in curves}) == len(curves)


def _needs_met(adapter: Adapter, curve: EngineMethod, scene: Scene) -> bool:
    tried = adapter.sweeps[curve.variation.split(" = ")[0]]
    return not tried.needs or bool(tried.needs & features_of(scene))
