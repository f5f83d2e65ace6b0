"""Many trainings: which there are, what they cost, and their carrying out side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mbds_xsim.dataset.read import Dataset
from mbds_xsim.dataset.work import Carrier
from mbds_xsim.errors import InputError, UnknownName
from mbds_xsim.isolate import Crash, Task
from mbds_xsim.learn.cost import Cost, measure
from mbds_xsim.learn.domains import Group
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.mixture import trainings
from mbds_xsim.learn.model import load_model, trainable
from mbds_xsim.learn.progress import TrainingSink, watched
from mbds_xsim.learn.refusal import refusal
from mbds_xsim.learn.runs import Run, carry_out, check_data, finished
from mbds_xsim.learn.train import PROFILES, Profile
from mbds_xsim.learn.window import names_read

__all__ = [
    "LONG",
    "Campaign",
    "Outcome",
    "Request",
    "carry",
    "costs",
    "diverged",
    "planned",
    "profile_named",
]

_MEASURING = 600.0  # of one model [s]
LONG = 1000
"""Steps of a run from which its cost is to be told first."""
_TRACKS = {"smoke": "lite", "lite": "lite", "paper": "paper"}


@dataclass(frozen=True)
class Request:
    """What is to be trained."""

    groups: Sequence[Group]
    models: Sequence[str]
    on: str
    """Words of `mixture.trainings`."""
    seeds: int
    profile_name: str
    profile: Profile
    out: Path
    track: str | None = None
    """That of the profile when left out."""
    device: str = "cpu"
    events: Path | None = None


@dataclass(frozen=True)
class Campaign:
    """The runs of a request."""

    runs: tuple[Run, ...]
    """Still to be carried out, wholly or in part."""
    found: dict[str, dict[str, str]]
    """Facts of those that have been, by their name."""
    left_out: dict[str, str]
    """Why a model or an engine is not, by scene, variant and its name."""
    blocked: dict[str, str]
    """Of a campaign that is only planned, which of the runs have another's file in their place."""


@dataclass
class Outcome:
    """What came of the runs of a campaign."""

    trained: dict[str, dict[str, str]] = field(default_factory=dict)
    """Facts of each run that was carried out now, by its name."""
    failed: dict[str, str] = field(default_factory=dict)
    """Why a run's process ended without a result; asked for again, it goes on."""


def profile_named(name: str) -> Profile:
    """Give a profile.

    Raises:
        UnknownName: There is none of that name.
    """
    if name not in PROFILES:
        raise UnknownName.of("profile", name, list(PROFILES))
    return PROFILES[name]


def planned(request: Request, *, only: bool = False) -> Campaign:
    """List the runs.

    Args:
        request: What is to be trained.
        only: Whether nothing will be written, so that nothing can be in its place.

    Raises:
        InputError: A model, track or training is not there, data are too few or too short for it
            or not what was written, or in the place of a run there is another.
    """
    track = request.track or _TRACKS[request.profile_name]
    _check_models(request.models, track)
    pairs = [(group, model) for group in request.groups for model in request.models]
    reasons = {
        (group, model): refusal(model, Graph.of(group.scene), track=track) for group, model in pairs
    }
    runs = [
        run
        for (group, model), reason in reasons.items()
        if not reason
        for run in _runs(request, group, model, track)
    ]
    if not runs:
        told = "; ".join(f"{model}: {reason}" for (_, model), reason in reasons.items())
        raise InputError(f"nothing to train: {told}")
    for run in runs:
        check_data(run)
    found, blocked = _found(runs, only=only)
    missing = tuple(run for run in runs if run.name not in found)
    _check_contents(missing)
    return Campaign(
        runs=missing,
        found=found,
        left_out={
            f"{group.name}/{engine}": lack
            for group in request.groups
            for engine, lack in group.left_out.items()
        }
        | {f"{group.name}/{model}": reason for (group, model), reason in reasons.items() if reason},
        blocked=blocked,
    )


def _found(runs: Sequence[Run], *, only: bool) -> tuple[dict[str, dict[str, str]], dict[str, str]]:
    """Give the facts of finished runs, and why others could not be written."""
    found: dict[str, dict[str, str]] = {}
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
            found[run.name] = facts
    return found, blocked


def _check_contents(runs: Sequence[Run]) -> None:
    """Refuse data that are not what was written: a model's file will bear their checksums."""
    names: dict[Dataset, set[str]] = {}
    for run in runs:
        read = names_read(bodies=load_model(run.model).needs_bodies)
        for engine in run.share.engines:
            names.setdefault(run.group.data[engine], set()).update(read)
    for data, needed in names.items():
        data.check(needed)


def _check_models(models: Sequence[str], track: str) -> None:
    for model in models:
        if model not in trainable():
            raise UnknownName.of("model to train", model, trainable())
        if track not in load_model(model).tracks:
            msg = f"--track: got {track!r}, allowed is {', '.join(load_model(model).tracks)}"
            raise InputError(msg)


def _runs(request: Request, group: Group, model: str, track: str) -> Iterator[Run]:
    for seed in range(request.seeds):
        for training, share in trainings(group, request.on).items():
            yield Run(
                group=group,
                training=training,
                share=share,
                model=model,
                track=track,
                profile_name=request.profile_name,
                profile=request.profile,
                seed=seed,
                out=request.out.absolute(),
                device=request.device,
                events=request.events and request.events.absolute(),
            )


def costs(campaign: Campaign, *, workers: int | None, carrier: Carrier) -> list[Cost]:
    """Measure one run of each model on each group, as many at a time as will train.

    Raises:
        InputError: A model cannot be tried.
    """
    first = {(run.group.name, run.model): run for run in reversed(campaign.runs)}
    runs = [first[key] for key in reversed(first)]
    answers = carrier([Task(measure, (run,), _MEASURING) for run in runs], workers=workers)
    for run, answer in zip(runs, answers, strict=True):
        if isinstance(answer, Crash):
            msg = f"{run.name} cannot be tried: {answer.reason}"
            raise InputError(msg)
    return answers


def carry(
    campaign: Campaign,
    *,
    workers: int | None,
    carrier: Carrier,
    progress: TrainingSink,
    costs: Iterable[Cost] = (),
) -> Outcome:
    """Carry out the runs that are still to be, the longest first; interrupted ones go on.

    Raises:
        InputError: Nothing can be written.
    """
    outcome = Outcome()
    hours = {(cost.group, cost.model): cost.hours for cost in costs}
    runs = sorted(campaign.runs, key=lambda run: -hours.get((run.group.name, run.model), 0.0))
    progress.begin(len(campaign.found), [run.profile.steps for run in runs])
    tasks = [Task(carry_out, (run,), math.inf) for run in runs]
    with watched(runs, progress):
        carrier(tasks, workers=workers, finished=_noted(runs, outcome, progress))
    return outcome


def _noted(
    runs: Sequence[Run], outcome: Outcome, progress: TrainingSink
) -> Callable[[int, object], None]:
    """Make what is called at the end of each run."""

    def note(place: int, answer: object) -> None:
        run = runs[place]
        if isinstance(answer, Crash):
            if answer.refused:
                raise InputError(answer.reason)
            outcome.failed[run.name] = answer.reason
            progress.ended(run.name, run.profile.steps, f"failed: {answer.reason}")
            return
        assert isinstance(answer, dict)
        outcome.trained[run.name] = answer
        progress.ended(run.name, run.profile.steps, told(answer))

    return note


def diverged(runs: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Name the runs whose losses stopped being numbers."""
    return [name for name, facts in runs.items() if facts.get("ended") == "diverged"]


def told(facts: dict[str, str]) -> str:
    """Say in a few words how a run ended."""
    ways = {
        "level": "level after {steps} steps",
        "steps": "all {steps} steps",
        "diverged": "diverged at step {steps}",
    }
    error, rate = float(facts["best_error"]), float(facts["steps_per_s"])
    way = ways[facts["ended"]].format(steps=facts["steps"])
    return f"{way}, best error {error:.3g} m² ({float(facts['wall_s']):.0f} s, {rate:.3g} steps/s)"
