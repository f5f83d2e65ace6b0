"""Nothing of a trade-off is measured twice, and failures are results."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.isolate import HERE, Crash, Task
from mbds_xsim.measure import runner
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.simulator import EngineMethod
from mbds_xsim.studies.tradeoff import Measurement, bench
from mbds_xsim.studies.tradeoff.bench import measure
from tests.plugins import faulty
from tests.study.tradeoffs import curve_of, shortened, store, studied

_HANG = 2.0  # [s] until a hanging task is ended

pytestmark = pytest.mark.usefixtures("few_steps")


def test_a_second_study_measures_nothing(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    first = studied(scene, "mujoco")
    monkeypatch.setattr(bench, "measure", _never)

    second = studied(scene, "mujoco")

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
        studied(scene, "mujoco")

    study = studied(scene, "mujoco")

    assert study.kept == 5
    assert study.measured == len(calls) - 5
    assert len(set(calls)) == len(calls)
    assert interrupted[0] in calls


def test_other_settings_engines_or_physics_are_measured_anew(scene: Scene) -> None:
    first = studied(scene, "mujoco")

    more = studied(scene, "mujoco", starts=2)
    heavier = msgspec.structs.replace(scene, gravity=(0.0, 0.0, -12.0))

    assert more.kept == first.measured
    assert more.measured > 0
    assert studied(heavier, "mujoco", starts=1).kept == 0
    assert studied(scene, "mujoco", fresh=True).measured == first.measured


@pytest.mark.parametrize(("kind", "again"), [("done", 0), ("failed", 0), ("crashed", 1)])
def test_a_crash_is_measured_again(scene: Scene, kind: Any, again: int) -> None:
    start = draw_batch(scene, [1])
    truth = bench.Truth(reference.solve(scene, start), np.ones((1, 21)))
    case = bench.StartBench(scene, start, [truth], 0, 30.0, HERE)._case(
        bench.Job(EngineMethod("mujoco", "RK4", own_options={}), 5, 0)
    )
    store(scene).add(msgspec.structs.replace(case.row, kind=kind))

    later = bench.StartBench(scene, start, [truth], 0, 30.0, HERE)

    assert len(later.runner.missing([case])) == again


def test_a_lost_limit_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    short = shortened("particlecar", 4)
    with monkeypatch.context() as patch:
        patch.setattr(bench, "run_tasks", lambda tasks, **_: [Crash("killed") for _ in tasks])
        without = studied(short, "pybullet")
        assert studied(short, "pybullet").measured == 0

    known = studied(short, "pybullet")

    points = [curve_of(each, "pybullet semi-implicit-euler").points for each in (without, known)]
    assert all(point.error_m is None for point in points[0])
    assert all(point.error_m is not None for point in points[1])
    assert known.measured == without.measured
    assert studied(short, "pybullet").measured == 0


def test_a_line_that_was_cut_off_is_passed_over(scene: Scene) -> None:
    first = studied(scene, "mujoco")
    path = store(scene).path
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])

    second = studied(scene, "mujoco")

    assert (second.kept, second.measured) == (first.measured - 1, 1)
    assert len(store(scene).rows) == first.measured


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


@pytest.mark.parametrize("known", [True, False])
def test_numbers_that_are_none_are_no_error(scene: Scene, tmp_path: Path, known: bool) -> None:
    scene = scene if known else shortened("particlecar", 4)
    with faulty(tmp_path / "packages", "losing"):
        study = studied(scene, "losing")
        again = studied(scene, "losing")

    assert (again.measured, again.curves) == (0, study.curves)
    points = (point for curve in study.curves for point in curve.points)
    told = {(point.kind, point.error_m, "finite" in point.broken) for point in points}
    assert told == {("done", None, True)}


@pytest.mark.usefixtures("faulty_engines")
@pytest.mark.slow
def test_crash_time_out_and_nan_are_listed_results(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.COUNTS", (4,))
    monkeypatch.setattr(runner, "Task", _impatient)
    engines = "mujoco,aborting,hanging,blowing"

    study = studied(scene, engines, starts=1, workers=8)

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
    again = store(scene)
    assert {row.kind for row in again.rows.values()} == {"done", "failed", "crashed", "timed out"}
    assert all(isinstance(row, Measurement) for row in again.rows.values())
