"""The study itself: orders as declared, nothing measured twice, failures as results."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.isolate import HERE, Crash, Task
from mbds_xsim.measure import runner
from mbds_xsim.measure.runner import Store
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate import registry, timed
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.claims import features_of
from mbds_xsim.simulate.simulator import NATIVE, EngineMethod
from mbds_xsim.studies.tradeoff import Measurement, Tradeoff, bench, curves_of
from mbds_xsim.studies.tradeoff import study as study_module
from mbds_xsim.studies.tradeoff.bench import LIMIT_COUNT, measure
from mbds_xsim.studies.tradeoff.curves import OWN_LIMIT, curve_results
from mbds_xsim.studies.tradeoff.study import rollout_cost, tradeoff, tradeoff_with_rows
from tests.plugins import faulty

_HANG = 2.0  # [s] until a hanging task is ended


@pytest.fixture(autouse=True)
def _small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep rows and references apart, and try few steps."""
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.COUNTS", (1, 2, 5, 10, 20))
    monkeypatch.setattr("mbds_xsim.studies.tradeoff._THIN", (5,))
    monkeypatch.setattr(timed, "_ENOUGH", 0.01)


@pytest.fixture
def scene() -> Scene:
    """A smooth scene, cut short."""
    return msgspec.structs.replace(registry.load_scene("2pendulum"), clock=Clock(0.02, 20))


def _study(scene: Scene, engines: str = "mujoco,exudyn", **how: Any) -> Tradeoff:
    return tradeoff(scene, engines=engines.split(","), **({"starts": 1, "workers": 0} | how))


def _store(scene: Scene) -> Store[Measurement]:
    return Store.of("tradeoff", scene.name, Measurement)


def _curve(study: Tradeoff, name: str) -> Any:
    return next(curve for curve in study.curves if curve.name == name)


def test_measured_orders_are_those_declared(scene: Scene) -> None:
    study = _study(scene)

    for name in ("mujoco RK4", "mujoco Euler", "exudyn trapezoidal", "exudyn generalised-alpha"):
        curve = _curve(study, name)
        assert curve.measured_order == pytest.approx(curve.order, abs=0.25), name
    assert {point.kind for curve in study.curves for point in curve.points} == {"done"}


def test_the_error_is_at_the_end_of_a_scene_shorter_than_a_second(scene: Scene) -> None:
    study = _study(scene, "mujoco")

    assert study.horizon_s == pytest.approx(0.4)
    first = _curve(study, "mujoco Euler").points[0]
    assert 0.0 < first.error_m <= 10.0 * first.error_weighted_m


def test_times_are_the_median_of_starts_and_repeats(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timed, "_ENOUGH", math.inf)
    monkeypatch.setattr(timed, "_MOST_REPEATS", 3)
    study, rows = tradeoff_with_rows(scene, choice=Choice.parse(engines="mujoco"), conduct=HERE)

    first = _curve(study, "mujoco RK4").points[0]
    own = [r for r in rows if (r.method, r.variation) == ("RK4", "")]
    own = [row for row in own if row.steps_per_frame == first.steps_per_frame]
    assert [row.trajectory for row in own] == [1, 4, 7]
    assert [len(row.wall_s) for row in own] == [3, 3, 3]
    medians = [statistics.median(row.wall_s) for row in own]
    assert first.wall_s == pytest.approx(statistics.median(medians))
    assert first.wall_low_s <= first.wall_s <= first.wall_high_s


def test_a_second_study_measures_nothing(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    first = _study(scene, "mujoco")
    monkeypatch.setattr(bench, "measure", _never)

    second = _study(scene, "mujoco")

    assert (first.kept, second.measured) == (0, 0)
    assert second.kept == first.measured
    assert second.curves == first.curves


def test_an_interrupted_study_goes_on_where_it_stopped(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def counted(*arguments: Any) -> Any:
        simulator, _, start, count, _ = arguments
        call = f"{simulator.name} {count} {start.index}"
        if len(calls) == 5 and call not in interrupted:
            interrupted.append(call)
            raise KeyboardInterrupt
        calls.append(call)
        return measure(*arguments)

    interrupted: list[str] = []
    monkeypatch.setattr(bench, "measure", counted)
    with pytest.raises(KeyboardInterrupt):
        _study(scene, "mujoco")

    study = _study(scene, "mujoco")

    assert study.kept == 5
    assert study.measured == len(calls) - 5
    assert len(set(calls)) == len(calls)
    assert interrupted[0] in calls


def test_other_settings_engines_or_physics_are_measured_anew(scene: Scene) -> None:
    first = _study(scene, "mujoco")

    more = _study(scene, "mujoco", starts=2)
    heavier = msgspec.structs.replace(scene, gravity=(0.0, 0.0, -12.0))

    assert more.kept == first.measured
    assert more.measured > 0
    assert _study(heavier, "mujoco", starts=1).kept == 0
    assert _study(scene, "mujoco", fresh=True).measured == first.measured


def test_what_would_take_too_long_is_listed(scene: Scene) -> None:
    study = _study(scene, "mujoco", limit=1e-6)

    curve = _curve(study, "mujoco RK4")
    assert [point.kind for point in curve.points] == ["done", *["too slow"] * 5]
    assert "limit 1e-06 s" in curve.points[1].reason


def test_steps_go_on_until_the_budget_is_kept_tenfold(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.COUNTS", (1, 2, 4, 8, 16, 32))
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.study.SPAN", 4)
    budget = scene.budget.error_1s * scene.length

    study = _study(scene, "mujoco")

    precise = _curve(study, "mujoco RK4").points
    coarse = _curve(study, "mujoco Euler").points
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
    row = msgspec.structs.replace(_ROW, kind=kind, error_m=error_m)
    known = reference.solve(scene, draw_batch(scene, [1]))
    truth = bench.Truth(known, np.ones((1, 21)))
    workbench = bench.StartBench(scene, draw_batch(scene, [1]), [truth], 0, 30.0, HERE)

    assert study_module._next_count(workbench, curve, [row]) == following


@pytest.mark.parametrize(("kind", "again"), [("done", 0), ("failed", 0), ("crashed", 1)])
def test_a_crash_is_measured_again(scene: Scene, kind: Any, again: int) -> None:
    start = draw_batch(scene, [1])
    truth = bench.Truth(reference.solve(scene, start), np.ones((1, 21)))
    case = bench.StartBench(scene, start, [truth], 0, 30.0, HERE)._case(
        bench.Job(EngineMethod("mujoco", "RK4", own_options={}), 5, 0)
    )
    _store(scene).add(msgspec.structs.replace(case.row, kind=kind))

    later = bench.StartBench(scene, start, [truth], 0, 30.0, HERE)

    assert len(later.runner.missing([case])) == again


def test_a_lost_limit_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    car = registry.load_scene("particlecar")
    short = msgspec.structs.replace(car, clock=msgspec.structs.replace(car.clock, steps=4))
    with monkeypatch.context() as patch:
        patch.setattr(bench, "run_tasks", lambda tasks, **_: [Crash("killed") for _ in tasks])
        without = _study(short, "pybullet")
        assert _study(short, "pybullet").measured == 0

    known = _study(short, "pybullet")

    points = [_curve(each, "pybullet semi-implicit-euler").points for each in (without, known)]
    assert all(point.error_m is None for point in points[0])
    assert all(point.error_m is not None for point in points[1])
    assert known.measured == without.measured
    assert _study(short, "pybullet").measured == 0


def test_with_frames_above_a_second_the_error_is_at_the_first() -> None:
    slow = msgspec.structs.replace(
        registry.load_scene("2pendulum"), clock=Clock(1.25, 2), gravity=(0.0, 0.0, -0.05)
    )

    study = _study(slow, "mujoco")

    assert (study.horizon_s, study.own_limit) == (1.25, None)
    assert all(point.error_m for point in _curve(study, "mujoco RK4").points)


def test_a_row_says_when_the_error_of_its_own_start_was_taken() -> None:
    cubli = registry.load_scene("simplecubli")
    short = msgspec.structs.replace(cubli, clock=msgspec.structs.replace(cubli.clock, steps=40))
    starts = draw_batch(short, [1, 4], seed=0)
    known = reference.solve(short, starts)
    ends = [failure.frame * short.clock.frame for failure in known.failures if failure]
    truths = [bench.Truth(known[[row]], np.ones((1, starts.steps + 1))) for row in range(2)]
    workbench = bench.StartBench(short, starts, truths, 0, 30.0, HERE)

    cases = [workbench._case(bench.Job(EngineMethod("mujoco", "RK4"), 1, row)) for row in range(2)]

    last = [pytest.approx(end - short.clock.frame) for end in ends]
    assert [case.row.horizon_s for case in cases] == last
    assert len({case.row.horizon_s for case in cases}) == 2
    assert workbench.horizon == min(case.row.horizon_s for case in cases)


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


def test_contact_without_a_unique_answer_ends_the_error_at_the_first_impact() -> None:
    cubli = registry.load_scene("simplecubli")
    short = msgspec.structs.replace(cubli, clock=msgspec.structs.replace(cubli.clock, steps=60))

    study = _study(short, "mujoco", starts=1)

    assert study.reference_ends_s is not None
    assert study.horizon_s <= study.reference_ends_s < 0.8
    assert study.horizon_s > 0.2
    assert _curve(study, "mujoco RK4").points[0].error_m < 1e-6
    assert not any("error at 1 s" in point.broken for c in study.curves for point in c.points)


def test_contact_from_the_start_holds_each_method_to_its_own_limit() -> None:
    car = registry.load_scene("particlecar")
    short = msgspec.structs.replace(car, clock=msgspec.structs.replace(car.clock, steps=4))

    study = _study(short, "pybullet")

    assert study.own_limit == LIMIT_COUNT
    points = _curve(study, "pybullet semi-implicit-euler").points
    errors = [point.error_m for point in points]
    assert all(coarse > fine > 0 for coarse, fine in pairwise(errors))
    assert all("error at 1 s" not in point.broken for point in points)
    allowed = short.budget.error_1s * short.length
    assert [OWN_LIMIT in point.broken for point in points] == [e > allowed for e in errors]
    assert max(point.steps_per_frame for point in points) < LIMIT_COUNT
    assert _study(short, "pybullet").measured == 0


_ROW = Measurement(
    key="", scene="particlecar", engine="pybullet", version="1", method="semi-implicit-euler",
    variation="", options={}, steps_per_frame=1, step_s=0.02, trajectory=1, seed=0,
    machine="", limit_s=1.0, kind="done", wall_s=(1.0,), cpu_s=(1.0,),
)  # fmt: skip


@pytest.mark.parametrize("own_limit", [True, False])
def test_without_a_limit_of_its_own_nothing_is_near_it(own_limit: bool) -> None:
    car = registry.load_scene("particlecar")
    curve = EngineMethod("pybullet", "semi-implicit-euler", own_options={})

    (result,) = curve_results(car, [curve], [[[_ROW]]], own_limit=own_limit)

    assert result.points[0].broken == ((OWN_LIMIT,) if own_limit else ())


@pytest.mark.parametrize("own_limit", [True, False])
def test_a_run_is_not_compared_with_itself(own_limit: bool) -> None:
    """Fifty contact substeps at 1 ms are the same steps as five at 0.1 ms, the limit's own."""
    car = registry.load_scene("particlecar")
    curve = EngineMethod("exudyn", "trapezoidal", variation="contact_substeps = 50", own_options={})
    row = msgspec.structs.replace(_ROW, error_m=0.0, error_weighted_m=0.0)

    (result,) = curve_results(car, [curve], [[[row]]], own_limit=own_limit)

    (point,) = result.points
    assert (point.error_m is None, point.on_front) == (own_limit, not own_limit)
    assert not point.broken


def test_a_line_that_was_cut_off_is_passed_over(scene: Scene) -> None:
    first = _study(scene, "mujoco")
    path = _store(scene).path
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])

    second = _study(scene, "mujoco")

    assert (second.kept, second.measured) == (first.measured - 1, 1)
    assert len(_store(scene).rows) == first.measured


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


def _never(*_: Any) -> Any:
    pytest.fail("measured again")


@pytest.fixture
def faulty_engines(tmp_path: Path) -> Iterator[None]:
    with faulty(tmp_path / "packages", "aborting", "hanging", "blowing"):
        yield


@functools.wraps(Task)
def _impatient(function: Callable[..., Any], arguments: tuple[Any, ...], timeout: float) -> Task:
    simulator = arguments[1][0][0]
    return Task(function, arguments, _HANG if simulator.engine == "hanging" else timeout)


@pytest.mark.usefixtures("faulty_engines")
@pytest.mark.slow
def test_crash_time_out_and_nan_are_listed_results(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.COUNTS", (4,))
    monkeypatch.setattr(runner, "Task", _impatient)
    engines = "mujoco,aborting,hanging,blowing"

    study = _study(scene, engines, starts=1, workers=8)

    def kinds(engine: str) -> set[tuple[str, str]]:
        curves = [curve for curve in study.curves if curve.engine == engine]
        return {(point.kind, point.reason) for curve in curves for point in curve.points}

    assert {kind for kind, _ in kinds("mujoco")} == {"done"}
    assert kinds("blowing") == {("failed", "frame 1: a number is not finite")}
    assert kinds("hanging") == {("timed out", f"no answer within {_HANG:g} s")}
    ((kind, reason),) = kinds("aborting")
    assert (kind, "SIGABRT" in reason) == ("crashed", True)
    assert all(
        point.wall_s is None and not point.on_front and math.isfinite(point.step_s)
        for curve in study.curves
        if curve.engine != "mujoco"
        for point in curve.points
    )
    # A time-out counts only as long as no more time is given.
    again = _store(scene)
    assert {row.kind for row in again.rows.values()} == {"done", "failed", "crashed", "timed out"}
    assert all(isinstance(row, Measurement) for row in again.rows.values())
