"""What is told while models are trained: the bar on the terminal, and TensorBoard."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import pytest
from rich.console import Console

from mbds_xsim.learn.curves import EventLog, log_whole, read_curve
from mbds_xsim.learn.train import CurvePoint
from mbds_xsim.learn.trainings import planned, watched
from mbds_xsim.report.progress import TrainingBar
from tests.learn.carried import Deaf, carry_out, interrupt
from tests.learn.conftest import Ask


def test_a_curve_that_was_left_over_is_not_the_runs(
    ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run's model was removed, so that it is trained anew; the bar starts from zero."""
    carry_out(ask())
    (run,) = (r for r in planned(ask(out="other")).runs)
    run = dataclasses.replace(run, request=ask())
    run.path.unlink()
    calls = []
    monkeypatch.setattr(Deaf, "reached", lambda *words, **more: calls.append((words, more)))
    with watched([run], Deaf()):
        pass
    assert calls == []
    run.checkpoint.touch()
    with watched([run], Deaf()):
        pass
    assert [more for _, more in calls] == [{"before": True}]


def test_the_bar_counts_runs_and_only_the_steps_of_this_process() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=160)
    with TrainingBar(console) as bar:
        bar.begin(1, [100, 100])
        bar.reached("a", 40, 2e-3, before=True)
        bar.reached("a", 50, 1e-3, before=False)
        (task,) = bar._progress.tasks
        assert (task.completed, task.total) == (50, 200)
        assert bar._taken == 10
        assert task.fields["last"] == "a: 0.001 m² at 50"
        bar.ended("a", 100, "level after 50 steps")
        assert task.completed == 100
        assert task.fields["runs"] == "2/3 runs"
    stream = console.file
    assert isinstance(stream, io.StringIO)
    assert "a: level after 50 steps" in stream.getvalue()


def test_tensorboard_is_told(tmp_path: Path) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    with EventLog(tmp_path) as log:
        points = [CurvePoint(step, 1.0 / step, 2.0 / step, 1e-3) for step in (10, 20)]
        for count in (1, 2, 2):
            log.add(points[:count])
    read = reading.EventAccumulator(str(tmp_path))
    read.Reload()
    assert [(e.step, e.value) for e in read.Scalars("error")] == [
        (10, pytest.approx(0.2)),
        (20, pytest.approx(0.1)),
    ]


@pytest.mark.parametrize("logged", [True, False])
def test_tensorboard_is_told_of_the_time_before_an_interruption(
    ask: Ask, tmp_path: Path, *, logged: bool
) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    watched_run = dataclasses.replace(ask(), events=tmp_path / "events")
    interrupt(watched_run if logged else ask())
    (run,) = planned(watched_run).runs
    carry_out(watched_run)
    read = reading.EventAccumulator(str(tmp_path / "events" / run.name))
    read.Reload()
    assert [event.step for event in read.Scalars("error")] == [4, 8, 12]


def test_tensorboard_is_told_of_a_run_that_was_finished_before(ask: Ask, tmp_path: Path) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    request = ask()
    carry_out(request)
    (name,) = planned(request).done
    for _ in range(2):  # once is enough
        log_whole(request.out / f"{name}.curve.json", tmp_path / "events")
    read = reading.EventAccumulator(str(tmp_path / "events"))
    read.Reload()
    points = read_curve(request.out / f"{name}.curve.json").points
    assert [event.step for event in read.Scalars("error")] == [point.step for point in points]
