"""One training run: its identity, its files, its execution and its cost.

`…/6pendulum/native/gns/mujoco-s0.pt` is the model, `….curve.json` its learning curve, and
`….checkpoint` the file from which an unfinished run resumes.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import torch

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.dataset.hdf5 import CONTENT
from mbds_xsim.dataset.variant import folder_name
from mbds_xsim.learn.curves import EventLog, LearningCurve, write_curve
from mbds_xsim.learn.groups import Share, TrainingGroup, check_share, mixed
from mbds_xsim.learn.model import LearnedModel, build, load_model, track_of
from mbds_xsim.learn.model_file import read_facts, save_model
from mbds_xsim.learn.recipe import TRACKS, Profile, Recipe, put
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.train import Training, check_identity, read_identity, train
from mbds_xsim.learn.window import HISTORY, Motions

Parts = tuple[Motions, Motions]

_FEW = 32  # trajectories to measure the cost on
_WARM = 3  # first steps, which allocate what later steps reuse
_STEPS = 20
_LONGEST = 5.0  # longest duration of the measured steps [s]


@dataclass(frozen=True)
class TrainingRequest:
    """Request for trainings: models and data, duration, and place of the files."""

    groups: Sequence[TrainingGroup]
    models: Sequence[str]
    on: str
    """Choice of trainings, in the words of `groups.shares_of`."""
    seeds: int
    profile_name: str
    profile: Profile
    out: Path
    track: str | None = None
    """Track of hyper-parameters; None: the profile's, or else the last track of a model."""
    device: str = "cpu"
    events: Path | None = None
    """Folder for TensorBoard's files, if any."""


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """Model, training data and seed of one run."""

    group: TrainingGroup
    training: str
    """Name of the training: `mujoco`, `not-mujoco`, `all`, `mujoco-low`."""
    share: Share
    model: str
    seed: int
    request: TrainingRequest
    """Request that the run is part of, with absolute paths."""

    @property
    def profile(self) -> Profile:
        """Length of the training, and its validations."""
        return self.request.profile

    @property
    def track(self) -> str:
        """Name of the run's hyper-parameters."""
        return track_of(self.model, self.request.track, TRACKS[self.request.profile_name])

    @property
    def name(self) -> str:
        """Name of the run, as in `6pendulum/native/gns/mujoco-s0`."""
        scene = folder_name(self.group.scene_name)
        return f"{scene}/{self.group.variant}/{self.model}/{self.training}-s{self.seed}"

    @property
    def path(self) -> Path:
        """File of the model."""
        return self.request.out / f"{self.name}.pt"

    @property
    def curve(self) -> Path:
        """File of the learning curve."""
        return self.request.out / f"{self.name}.curve.json"

    @property
    def checkpoint(self) -> Path:
        """File from which an interrupted run resumes."""
        return self.request.out / f"{self.name}.checkpoint"

    @property
    def settings(self) -> Any:
        """Hyper-parameters of the model in the track."""
        return load_model(self.model).tracks[self.track]

    @property
    def recipe(self) -> Recipe:
        """Optimiser settings of the track."""
        recipe: Recipe = self.settings.recipe
        return recipe

    @property
    def identity(self) -> dict[str, str]:
        """Facts that decide the result on one machine; another identity means another run."""
        data = {e: self.group.data[e].attributes[CONTENT] for e in self.share.engines}
        starts = hashlib.sha256()  # they depend on what all engines of the group have
        for split in ("train", "validation"):
            starts.update(self.share.numbers(self.group, split).astype("<i8").tobytes() + b"|")
        interval, revision = self.share.interval, load_model(self.model).revision
        return {
            "scene": self.group.scene_name,
            "variant": self.group.variant,
            "model": self.model,
            "training": self.training,
            "train_engines": ",".join(self.share.engines),
            "seed": str(self.seed),
            "track": self.track,
            "settings": msgspec.json.encode(self.settings).decode(),
            "profile": msgspec.json.encode(self.profile).decode(),
            "data": json.dumps(data),
            "starts": starts.hexdigest(),
            "drawn": json.dumps(self.group.drawn),
            "device": self.request.device,
            **({"interval": interval} if interval else {}),
            **({"revision": str(revision)} if revision else {}),
        }


def check_data(run: TrainingRun) -> None:
    """Raise InputError if a run's data are too few or too short."""
    for split in ("train", "validation"):
        check_share(run.group, run.share, split)
    data = next(iter(run.group.data.values()))
    frames, needed = int(data.attributes["steps"]) + 1, HISTORY + run.recipe.horizon
    if frames < needed:
        raise InputError(
            f"{data.path}: got trajectories of {frames} frames, {run.model} in the track "
            f"{run.track} needs at least {needed}; generate longer ones"
        )


def finished(run: TrainingRun) -> dict[str, str] | None:
    """Return the facts of a finished run, or None if it remains to be carried out.

    Raises InputError if the files of another run are in its place.
    """
    if run.path.exists():
        facts = read_facts(run.path)
        check_identity(run.path, "a model", facts, run.identity)
        return facts
    if run.checkpoint.exists():
        check_identity(run.checkpoint, "a checkpoint", read_identity(run.checkpoint), run.identity)
    return None


def prepared(
    run: TrainingRun, *, most: int | None = None
) -> tuple[LearnedModel, Statistics, Parts]:
    """Build the untrained model of a run; read its data, at most `most` trajectories of a part."""
    kind = load_model(run.model)
    kwargs = {"bodies": kind.needs_bodies, "device": run.request.device, "dtype": kind.dtype}
    training, validation = (
        mixed(run.group, run.share, split, most=most, **kwargs) for split in ("train", "validation")
    )
    statistics = Statistics.of(training)
    graph = training.graph.to("cpu")
    model = build(run.model, graph, statistics, track=run.track, seed=run.seed)
    put(model, run.request.device)
    return model, statistics, (training, validation)


def carry_out(run: TrainingRun) -> dict[str, str]:
    """Train or resume a run in a process of its own, write its files, and return its facts."""
    torch.set_num_threads(1)
    if known := finished(run):
        return known
    model, statistics, parts = prepared(run)
    run.checkpoint.parent.mkdir(parents=True, exist_ok=True)
    with EventLog(run.request.events and run.request.events / run.name) as log:

        def tell(training: Training) -> None:
            _write_curve(run, training)
            log.add(training.curve)

        training = train(
            model,
            *parts,
            run.recipe,
            run.profile,
            seed=run.seed,
            checkpoint=run.checkpoint,
            tell=tell,
            identity=run.identity,
        )
        log.add(training.curve)  # all of a run that had ended, but whose model was not written
    _write_curve(run, training)
    facts = {**run.identity, **facts_of(run, training, parts)}
    save_model(run.path, model, run.model, run.settings, statistics, **facts)
    run.checkpoint.unlink(missing_ok=True)
    return facts


def _write_curve(run: TrainingRun, training: Training) -> None:
    curve = LearningCurve(run.name, run.profile.steps, training.ended, training.curve)
    write_whole(run.curve, write_curve(curve))


def facts_of(run: TrainingRun, training: Training, parts: Parts) -> dict[str, str]:
    """Return the facts of a run in addition to its identity, as text."""
    steps = training.curve[-1].step
    # Relative to the folder of the data, as in `6pendulum/mujoco-native.h5`.
    files = {e: "/".join(run.group.files[e].parts[-2:]) for e in run.share.engines}
    enough = len(training.curve) >= run.profile.least and training.ended != "diverged"
    # Whether the last fifth of the steps improved validation too little to go on.
    level = enough and training.last_improvement < run.profile.improvement
    facts = {
        "profile_name": run.request.profile_name,
        "engines": ",".join(run.group.files),
        "files": json.dumps(files),
        "train_trajectories": len(parts[0]),
        "validation_trajectories": len(parts[1]),
        "steps": steps,
        "skipped_steps": training.skipped,
        "ended": training.ended,
        "level": "yes" if level else "no",
        "last_improvement": training.last_improvement,
        "best_error": training.best.error,
        "best_step": training.best_step,
        "wall_s": training.wall_s,
        "cpu_s": training.cpu_s,
        "steps_per_s": steps / training.wall_s,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "mbds_xsim": version("mbds-xsim"),
    }
    return {key: str(value) for key, value in facts.items()}


@dataclass(frozen=True)
class Cost:
    """Cost of one run of a model on one group, as it is trained here."""

    group: str
    model: str
    steps_per_s: float
    validation_s: float
    """Time of one validation [s]."""
    hours: float
    """Time of a run that takes all its steps [h]; it may end earlier, when level."""


def measure(run: TrainingRun) -> Cost:
    """Measure a few steps and a validation; to be called in a process of its own."""
    torch.set_num_threads(1)
    model, _, (training, validation) = prepared(run, most=_FEW)
    profile = msgspec.structs.replace(run.profile, until_level=False)

    def seconds(steps: int, motions: Motions, windows: int) -> float:
        """Measure the time of `steps` steps and a validation of `windows` windows."""
        short_profile = msgspec.structs.replace(profile, steps=steps, every=steps, windows=windows)
        begin = time.perf_counter()
        train(model, training, motions, run.recipe, short_profile)
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        return time.perf_counter() - begin

    warm_s = seconds(_WARM, validation, 1) / _WARM
    steps = max(1, min(_STEPS, round(_LONGEST / warm_s)))
    step_s = seconds(steps, validation[:1], 1) / steps
    # As many windows as a validation of the run has, but repeated from a few trajectories.
    windows = min(run.profile.windows, len(run.share.numbers(run.group, "validation")))
    copies = Motions.joined([validation] * math.ceil(windows / len(validation)))
    seconds(1, copies, windows)  # compiles kernels of this size
    validation_s = max(0.0, seconds(1, copies, windows) - step_s)
    validations = math.ceil(run.profile.steps / run.profile.every)
    return Cost(
        group=run.group.name,
        model=run.model,
        steps_per_s=1.0 / step_s,
        validation_s=validation_s,
        hours=(run.profile.steps * step_s + validations * validation_s) / 3600.0,
    )
