"""Many trainings: their planning, their cost, and their execution in parallel.

Progress is read from the curves that runs write, wherever they run.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Protocol

from mbds_xsim.base.errors import InputError, Unsupported, check_name
from mbds_xsim.base.isolate import Carrier, Crash, Task
from mbds_xsim.dataset.generate import repeating
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.curves import read_curve
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.groups import TrainingGroup, shares_of
from mbds_xsim.learn.model import load_model, model_names, refusal, track_of, trainable
from mbds_xsim.learn.model_file import check_settings
from mbds_xsim.learn.recipe import TRACKS
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
"""Facts about runs, keyed by run name."""

LONG = 1000
"""Number of steps above which the cost of a run is reported before it starts."""
_MEASURING = 600.0  # time limit for one model [s]
_ENDS = {
    "level": "level after {steps} steps",
    "steps": "all {steps} steps",
    "diverged": "diverged at step {steps}",
}
UNTRAINED = "no validation succeeded; its file has untrained parameters"
"""What is said of a run of which `is_untrained` holds."""


class TrainingSink(Protocol):
    """Receiver of progress reports."""

    def begin(self, done: int, most_steps: Sequence[int]) -> None:
        """Report the number of finished runs, and the maximum steps of each other run."""

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        """Report a run's step and validation error; `before`: an earlier process got there."""

    def ended(self, name: str, most_steps: int, how: str) -> None:
        """Report that a run is over, and how it ended."""


@dataclass(frozen=True)
class TrainingPlan:
    """The runs of a request."""

    runs: tuple[TrainingRun, ...]
    """Runs that remain to be carried out, wholly or in part."""
    done: Facts
    """Facts about finished runs, keyed by run name."""
    left_out: dict[str, str]
    """Reasons why models and engines are left out, keyed by scene, variant and name."""
    blocked: dict[str, str]
    """Runs that find another run's file in their place, with the reason; only if nothing is run."""


@dataclass
class TrainingOutcome:
    """Outcome of the runs of a plan."""

    trained: Facts = field(default_factory=dict)
    """Facts about each run that was carried out now."""
    failed: dict[str, str] = field(default_factory=dict)
    """Reasons why runs ended without a result; a new request resumes them."""


def planned(request: TrainingRequest, *, only: bool = False) -> TrainingPlan:
    """Plan the runs of a request; `only`, if nothing will be written and blocked runs are allowed.

    Raises:
        InputError: A model, track or training does not exist, its file could not be read, the data
            are too few, too short or damaged, or another run's files are in a run's place.
    """
    events = request.events and request.events.absolute()
    request = replace(request, out=request.out.absolute(), events=events)
    usual, tracks = TRACKS[request.profile_name], {}
    for model in request.models:
        if model in model_names():
            load_model(model)  # raises the reason if it cannot be used
        check_name("model to train", model, trainable())
        tracks[model] = track_of(model, request.track, usual)
        check_settings(model, tracks[model])
    reasons = {
        (group, model): _refusal(model, group, tracks[model])
        for group in request.groups
        if group.files
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
        refusals = "; ".join(f"{model}: {reason}" for (_, model), reason in reasons.items())
        raise InputError(f"nothing to train: {refusals}")
    for run in runs:
        check_data(run)
    done: Facts = {}
    blocked: dict[str, str] = {}
    for run in runs:
        try:
            if facts := finished(run):
                done[run.name] = facts
        except InputError as error:
            if not only:
                raise
            blocked[run.name] = str(error)
    missing = tuple(run for run in runs if run.name not in done)
    _check_contents(missing)
    left_out = {f"{g.name}/{e}": lack for g in request.groups for e, lack in g.left_out.items()}
    left_out |= {f"{group.name}/{model}": why for (group, model), why in reasons.items() if why}
    return TrainingPlan(missing, done, left_out, blocked)


def _refusal(model: str, group: TrainingGroup, track: str) -> str:
    """Return why a model cannot learn a group's scene, or ""."""
    try:
        return refusal(model, Graph.of(group.scene), track=track)
    except Unsupported as error:  # no model can
        return str(error)


def _check_contents(runs: Sequence[TrainingRun]) -> None:
    """Raise InputError for damaged data, because model files will state their checksums."""
    bodies: dict[Dataset, bool] = {}
    for run in runs:
        needed = load_model(run.model).needs_bodies
        for data in map(run.group.data.__getitem__, run.share.engines):
            bodies[data] = bodies.get(data, False) or needed
    for data, whole in bodies.items():
        data.check(names_read(data, bodies=whole))


def costs(plan: TrainingPlan, *, workers: int | None, carrier: Carrier) -> list[Cost]:
    """Measure the cost of one run of each model on each group, as many at a time as will train."""
    first = {(run.group.name, run.model): run for run in reversed(plan.runs)}
    runs = [first[key] for key in reversed(first)]
    answers = carrier([Task(measure, (run,), _MEASURING) for run in runs], workers=workers)
    for run, answer in zip(runs, answers, strict=True):
        if isinstance(answer, Crash):
            raise InputError(f"{run.name} cannot be tried: {answer.reason}")
    return answers


def carry(
    plan: TrainingPlan,
    *,
    workers: int | None,
    carrier: Carrier,
    progress: TrainingSink,
    costs: Iterable[Cost] = (),
) -> TrainingOutcome:
    """Carry out the remaining runs, the longest first; interrupted ones resume."""
    outcome = TrainingOutcome()
    hours = {(cost.group, cost.model): cost.hours for cost in costs}
    runs = sorted(plan.runs, key=lambda run: -hours.get((run.group.name, run.model), 0.0))

    def note(place: int, answer: dict[str, str] | Crash) -> None:
        run = runs[place]
        if not isinstance(answer, Crash):
            outcome.trained[run.name], how = answer, _ended(answer)
        elif answer.refused:
            raise InputError(answer.reason)
        else:
            outcome.failed[run.name], how = answer.reason, f"failed: {answer.reason}"
        progress.ended(run.name, run.profile.steps, how)

    progress.begin(len(plan.done), [run.profile.steps for run in runs])
    tasks = [Task(carry_out, (run,), math.inf) for run in runs]
    with watched(runs, progress):
        carrier(tasks, workers=workers, finished=note)
    return outcome


def _ended(facts: dict[str, str]) -> str:
    """Describe in a few words how a run ended."""
    error, rate = float(facts["best_error"]), float(facts["steps_per_s"])
    end = _ENDS[facts["ended"]].format(steps=facts["steps"])
    best = UNTRAINED if is_untrained(facts) else f"best error {error:.3g} m²"
    return f"{end}, {best} ({float(facts['wall_s']):.0f} s, {rate:.3g} steps/s)"


def is_untrained(facts: Mapping[str, str]) -> bool:
    """Whether no validation of a run succeeded, so that no parameters were found to be best."""
    return facts.get("best_error") == str(math.inf)


def diverged(runs: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return the names of the runs whose losses stopped being finite or all validations failed."""
    return [
        name
        for name, facts in runs.items()
        if facts.get("ended") == "diverged" or is_untrained(facts)
    ]


@contextmanager
def watched(runs: Sequence[TrainingRun], progress: TrainingSink) -> Iterator[None]:
    """Report new points of the runs' curves while the block runs."""
    # A curve without a checkpoint is of a removed run, and is written anew.
    times = {run.name: 0 if run.checkpoint.exists() else _changed(run) for run in runs}

    def look(*, before: bool = False) -> None:
        """Report the runs whose curve files have changed since the last look."""
        for run in runs:
            time = _changed(run)
            if time > times[run.name]:
                times[run.name] = time
                points = read_curve(run.curve).points
                if points:
                    progress.reached(run.name, points[-1].step, points[-1].error, before=before)

    look(before=True)
    with repeating(look):
        yield


def _changed(run: TrainingRun) -> int:
    """Return the time at which a run's curve was last written [ns], or 0."""
    return run.curve.stat().st_mtime_ns if run.curve.exists() else 0
