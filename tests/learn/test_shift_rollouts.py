"""Rollouts of a study: done once, gone on with when interrupted, few in memory at a time."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE, Conduct, Crash, Silent, Task
from mbds_xsim.learn.model import LearnedModel
from mbds_xsim.learn.particles import RolloutFigures, figures_on, read_figures
from mbds_xsim.learn.shift import rollouts, study
from mbds_xsim.learn.shift.domains import load_paired
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.trained import trivial_models
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.scene.state import Batch
from tests.learn.shifts import SCENE, SEEDS, TRAININGS, shift_of

pytestmark = pytest.mark.usefixtures("apart")


def test_what_was_tested_is_not_tested_again(
    studied: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(rollouts, "figures_on", refuse)
    again = shift_of(studied)
    assert again.cells == shift.cells
    assert again.gaps == shift.gaps


def test_without_the_cache_all_is_done_anew(
    studied: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested: list[tuple[Any, ...]] = []
    gone_on: list[tuple[Any, ...]] = []
    predicted = rollouts._predicted

    def noted_figures(*words: Any, **more: Any) -> RolloutFigures:
        tested.append(words)
        return figures_on(*words, **more)

    def noted_restart(*words: Any) -> torch.Tensor:
        gone_on.append(words)
        return predicted(*words)

    monkeypatch.setattr(rollouts, "figures_on", noted_figures)
    monkeypatch.setattr(rollouts, "_predicted", noted_restart)
    question = study.question_of(studied / "models", studied / "data", SCENE)
    again = study.study(question, conduct=Conduct(0, cache=False)).shift
    assert len(tested) == len(TRAININGS) * SEEDS + 3
    assert all(len(motions) == 3 * len(shift.index) for _, motions in tested)
    assert len({(job.engine.name, job.domain.name) for job, *_ in gone_on}) == 2 * 3
    assert again.cells == shift.cells
    assert again.gaps == shift.gaps


def test_restarts_that_were_interrupted_go_on(
    studied: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = load_paired(studied / "data", SCENE).domains
    rollouts.Restart(one, two, shift.horizon).path.unlink()
    predicted, done = rollouts._predicted, []

    def noted(job: rollouts.Restart, motions: Motions, inputs: Batch, *part: int) -> torch.Tensor:
        done.append((job.engine.name, job.domain.name))
        return predicted(job, motions, inputs, *part)

    monkeypatch.setattr(rollouts, "_predicted", noted)
    again = shift_of(studied)
    assert set(done) == {(one.name, two.name)}
    assert again.gaps == shift.gaps


def test_nothing_goes_on_where_no_motion_is_known(studied: Path) -> None:
    """An example is the time after the truth's last first impact."""
    paired = load_paired(studied / "data", SCENE)
    one, two = paired.domains
    motions = rollouts.Restart(one, two, 3).domain.motions(torch.float64)
    assert motions.body is not None
    unknown = dataclasses.replace(motions, body=torch.full_like(motions.body, torch.nan))
    predicted = rollouts._predicted(rollouts.Restart(one, two, 3), unknown, paired.batch, 3)
    assert predicted.shape[:2] == (len(motions), 3)
    assert torch.isnan(predicted).all()


def test_a_start_that_an_engine_refuses_later_does_not_lose_its_rollout(
    studied: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An example is a disc that has sunk into the ground: only the teacher-forced error is lost."""
    one, two = load_paired(studied / "data", SCENE).domains
    restart, predicted = rollouts.Restart(one, two, shift.horizon), rollouts._predicted
    whole = read_figures(restart.path)
    assert whole is not None

    def refusing(*words: Any) -> torch.Tensor:
        if words[4:] and words[4] > HISTORY:
            raise InputError("starts below the ground")
        return predicted(*words)

    monkeypatch.setattr(rollouts, "_predicted", refusing)
    rollouts._go_on(load_paired(studied / "data", SCENE).batch, [restart])
    again = read_figures(restart.path)
    restart.path.unlink()
    assert again is not None
    np.testing.assert_array_equal(again.error, whole.error)
    assert (again.one_step == np.inf).all()


class Count(Silent):
    """A meter that counts."""

    whole = counted = 0

    def begin(self, total: int, done: int = 0) -> None:
        self.whole += total + done

    def advance(self, work: str) -> None:
        del work
        self.counted += 1


def test_a_restart_that_crashes_takes_no_other_along(
    studied: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The restarts of its process are done alone; an unreadable file is made again."""
    test = load_paired(studied / "data", SCENE)
    one, two = test.domains
    jobs = [rollouts.Restart(one, domain, shift.horizon) for domain in (one, two)]
    jobs[0].path.unlink()
    jobs[1].path.write_bytes(b"no archive")

    def crashing(
        tasks: Sequence[Task], *, workers: int | None, finished: Callable[[int, object], None]
    ) -> list[object]:
        assert workers is None
        answers: list[object] = []
        for place, task in enumerate(tasks):
            if any(job.name == jobs[0].name for job in task.arguments[1]):
                answers.append(Crash("it broke"))
            else:
                task.function(*task.arguments)
                answers.append(None)
            finished(place, answers[-1])
        return answers

    meter = Count()
    with monkeypatch.context() as patch:
        patch.setattr(rollouts, "run_tasks", crashing)
        restarted, lost = rollouts.restarted(
            test, test.domains, shift.horizon, conduct=Conduct(meter=meter)
        )
    assert lost == {f"{one.name} on {one.name}": "it broke"}
    assert set(restarted) == {(e.name, d.name) for e in (one, two) for d in (one, two)} - {
        (one.name, one.name)
    }
    assert (meter.whole, meter.counted) == (2, 2)
    again = shift_of(studied)
    assert again.gaps == shift.gaps


def test_memory_holds_few_trajectories_and_no_figures(
    studied: Path, shift: Shift, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If there are too many, one domain is read at a time; figures are the same."""
    test = load_paired(studied / "data", SCENE)
    refs: list[weakref.ref[Motions]] = []

    def watched(model: LearnedModel, motions: Motions, **plan: Any) -> RolloutFigures:
        alive = {id(found) for ref in refs if (found := ref()) is not None}
        assert alive <= {id(motions)}
        refs.append(weakref.ref(motions))
        return figures_on(model, motions, **plan)

    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))
    monkeypatch.setattr(rollouts, "figures_on", watched)
    monkeypatch.setattr(rollouts, "_ROWS", len(test.index))
    entries, plan = trivial_models(), rollouts.RolloutPlan(shift.horizon)
    found = rollouts.evaluate(test.scene, entries, test.domains, plan, conduct=HERE)
    assert len(refs) == len(found) == len(entries) * len(test.domains)
    figures = weakref.ref(next(iter(found.values())))
    assert figures() is None
    alone = {key: found[key].error for key in found}
    monkeypatch.setattr(rollouts, "_ROWS", 512)
    anew = Conduct(0, cache=False)
    together = rollouts.evaluate(test.scene, entries, test.domains, plan, conduct=anew)
    assert len(refs) == len(found) + len(entries)
    for key, error in alone.items():
        np.testing.assert_allclose(together[key].error, error, rtol=1e-6)
