"""Many trainings: which there are, what they cost, and their carrying out side by side.

Progress is told from the curves that runs write, wherever they run.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Protocol

from mbds_xsim.base.errors import InputError, check_name
from mbds_xsim.base.isolate import Carrier, Crash, Task
from mbds_xsim.dataset.generate import repeating
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.curves import read_curve
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.groups import shares_of
from mbds_xsim.learn.model import load_model, model_names, refusal, track_of, trainable
from mbds_xsim.learn.recipe import PROFILES, TRACKS, Profile
from mbds_xsim.learn.runs import (
    Cost,
    TrainingRequest,
    TrainingRun,
    carry_out,
    check_data,
    finished,
    measure,
)
from mbds_xsim.learn.window import names_read

Facts = dict[str, dict[str, str]]
"""Of runs, by their name."""

LONG = 1000
"""Steps of a run from which its cost is to be told first."""
_MEASURING = 600.0  # of one model [s]
_ENDS = {
    "level": "level after {steps} steps",
    "steps": "all {steps} steps",
    "diverged": "diverged at step {steps}",
}


class TrainingSink(Protocol):
    """Where progress is told."""

    def begin(self, done: int, most_steps: Sequence[int]) -> None:
        """Say how many runs are done, and the most steps of each that is not."""

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        """Tell how far a run is and its validation error; `before`: an earlier process got so
        far.
        """

    def ended(self, name: str, most_steps: int, how: str) -> None:
        """Tell of a run that is over."""


@dataclass(frozen=True)
class TrainingPlan:
    """The runs of a request."""

    runs: tuple[TrainingRun, ...]
    """Still to be carried out, wholly or in part."""
    done: Facts
    """Of those that have been."""
    left_out: dict[str, str]
    """Why a model or an engine is not, by scene, variant and its name."""
    blocked: dict[str, str]
    """Where trainings are only planned, which runs have another's file in their place."""


@dataclass
class TrainingOutcome:
    """What came of the runs of a plan."""

    trained: Facts = field(default_factory=dict)
    """Of each run that was carried out now."""
    failed: dict[str, str] = field(default_factory=dict)
    """Why a run's process ended without a result; asked for again, it goes on."""


def profile_named(name: str) -> Profile:
    """Give a profile; UnknownName says which there are."""
    check_name("profile", name, PROFILES)
    return PROFILES[name]


def planned(request: TrainingRequest, *, only: bool = False) -> TrainingPlan:
    """List the runs; `only`, where nothing will be written, so that nothing can be in its place.

    Raises:
        InputError: A model, track or training is not there, data are too few or too short for it
            or not what was written, or in the place of a run there is another.
    """
    events = request.events and request.events.absolute()
    request = replace(request, out=request.out.absolute(), events=events)
    usual, tracks = TRACKS[request.profile_name], {}
    for model in request.models:
        if model in model_names():
            load_model(model)  # which says what is wrong with one that cannot be used
        check_name("model to train", model, trainable())
        tracks[model] = track_of(model, request.track, usual)
    reasons = {
        (group, model): refusal(model, Graph.of(group.scene), track=tracks[model])
        for group in request.groups
        for model in request.models
    }
    runs = [
        TrainingRun(group, training, share, model, seed, request)
        for (group, model), reason in reasons.items()
        if not reason
        for seed in range(request.seeds)
        for training, share in shares_of(group, request.on).items()
    ]
    if not runs:
        each = "; ".join(f"{model}: {reason}" for (_, model), reason in reasons.items())
        raise InputError(f"nothing to train: {each}")
    for run in runs:
        check_data(run)
    done: Facts = {}
    blocked: dict[str, str] = {}
    for run in runs:
        try:
            facts = finished(run)
        except InputError as error:
            if not only:
                raise
            blocked[run.name] = str(error)
            continue
        if facts is not None:
            done[run.name] = facts
    missing = tuple(run for run in runs if run.name not in done)
    _check_contents(missing)
    left_out = {f"{g.name}/{e}": lack for g in request.groups for e, lack in g.left_out.items()}
    left_out |= {f"{group.name}/{model}": why for (group, model), why in reasons.items() if why}
    return TrainingPlan(missing, done, left_out, blocked)


def _check_contents(runs: Sequence[TrainingRun]) -> None:
    """Refuse data that are not what was written: a model's file will bear their checksums."""
    names: dict[Dataset, set[str]] = {}
    for run in runs:
        read = names_read(bodies=load_model(run.model).needs_bodies)
        for engine in run.share.engines:
            names.setdefault(run.group.data[engine], set()).update(read)
    for data, needed in names.items():
        data.check(needed)


def costs(plan: TrainingPlan, *, workers: int | None, carrier: Carrier) -> list[Cost]:
    """Measure one run of each model on each group, as many at a time as will train."""
    first = {(run.group.name, run.model): run for run in reversed(plan.runs)}
    runs = [first[key] for key in reversed(first)]
    answers = carrier([Task(measure, (run,), _MEASURING) for run in runs], workers=workers)
    for run, answer in zip(runs, answers, strict=True):
        if isinstance(answer, Crash):
            msg = f"{run.name} cannot be tried: {answer.reason}"
            raise InputError(msg)
    return answers


def carry(
    plan: TrainingPlan,
    *,
    workers: int | None,
    carrier: Carrier,
    progress: TrainingSink,
    costs: Iterable[Cost] = (),
) -> TrainingOutcome:
    """Carry out the runs that are still to be, the longest first; interrupted ones go on."""
    outcome = TrainingOutcome()
    hours = {(cost.group, cost.model): cost.hours for cost in costs}
    runs = sorted(plan.runs, key=lambda run: -hours.get((run.group.name, run.model), 0.0))

    def note(place: int, answer: object) -> None:
        run = runs[place]
        if not isinstance(answer, Crash):
            assert isinstance(answer, dict)
            outcome.trained[run.name] = answer
            progress.ended(run.name, run.profile.steps, _ended(answer))
            return
        if answer.refused:
            raise InputError(answer.reason)
        outcome.failed[run.name] = answer.reason
        progress.ended(run.name, run.profile.steps, f"failed: {answer.reason}")

    progress.begin(len(plan.done), [run.profile.steps for run in runs])
    tasks = [Task(carry_out, (run,), math.inf) for run in runs]
    with watched(runs, progress):
        carrier(tasks, workers=workers, finished=note)
    return outcome


def _ended(facts: dict[str, str]) -> str:
    """Say in a few words how a run ended."""
    error, rate = float(facts["best_error"]), float(facts["steps_per_s"])
    way = _ENDS[facts["ended"]].format(steps=facts["steps"])
    return f"{way}, best error {error:.3g} m² ({float(facts['wall_s']):.0f} s, {rate:.3g} steps/s)"


def diverged(runs: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Name the runs whose losses stopped being numbers."""
    return [name for name, facts in runs.items() if facts.get("ended") == "diverged"]


@contextmanager
def watched(runs: Sequence[TrainingRun], progress: TrainingSink) -> Iterator[None]:
    """Tell what is added to the curves of some runs while the block runs."""
    # A curve without a checkpoint is of a run that was removed, and is made anew.
    known = {run.name: 0 if run.checkpoint.exists() else _changed(run) for run in runs}

    def look(*, before: bool = False) -> None:
        """Tell of the runs whose files are newer than when they were looked at last [ns]."""
        for run in runs:
            changed = _changed(run)
            if changed > known[run.name]:
                known[run.name] = changed
                points = read_curve(run.curve).points
                if points:
                    progress.reached(run.name, points[-1].step, points[-1].error, before=before)

    look(before=True)
    with repeating(look):
        yield


def _changed(run: TrainingRun) -> int:
    """When its curve was written last [ns]."""
    return run.curve.stat().st_mtime_ns if run.curve.exists() else 0
