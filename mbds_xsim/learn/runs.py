"""One training: what it is known by, where its files go, how it is carried out and what it costs.

`…/6pendulum/native/gns/mujoco-s0.pt` is the model, `….curve.json` its learning curve, and
`….checkpoint` what it goes on from while it is not done.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import msgspec
import torch

from mbds_xsim.dataset.content import CONTENT
from mbds_xsim.dataset.variant import folder_name
from mbds_xsim.errors import InputError
from mbds_xsim.learn.curves import EventLog, LearningCurve, write_curve
from mbds_xsim.learn.device import put
from mbds_xsim.learn.groups import Share, TrainingGroup, check_share, mixed
from mbds_xsim.learn.model import LearnedModel, build, load_model
from mbds_xsim.learn.model_file import read_facts, save_model
from mbds_xsim.learn.recipe import Recipe
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.train import Profile, Training, check_identity, read_identity, train
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.write import write_whole

__all__ = [
    "Cost",
    "TrainingRun",
    "carry_out",
    "check_data",
    "facts_of",
    "finished",
    "measure",
    "prepared",
    "recipe_of",
]


Parts = tuple[Motions, Motions]


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """A model, what it trains on, and a seed."""

    group: TrainingGroup
    training: str
    """Name: `mujoco`, `not-mujoco`, `all`, `mujoco-low`."""
    share: Share
    model: str
    track: str
    profile_name: str
    profile: Profile
    seed: int
    out: Path
    device: str = "cpu"
    events: Path | None = None
    """Folder of TensorBoard's files."""

    @property
    def name(self) -> str:
        """As in `6pendulum/native/gns/mujoco-s0`."""
        scene = folder_name(self.group.scene_name)
        return f"{scene}/{self.group.variant}/{self.model}/{self.training}-s{self.seed}"

    @property
    def path(self) -> Path:
        """The model's file."""
        return self.out / f"{self.name}.pt"

    @property
    def curve(self) -> Path:
        """The learning curve's."""
        return self.out / f"{self.name}.curve.json"

    @property
    def checkpoint(self) -> Path:
        """What a run that was interrupted goes on from."""
        return self.out / f"{self.name}.checkpoint"

    @property
    def identity(self) -> dict[str, str]:
        """What decides on the result, on one machine: a file of another identity is another run."""
        settings = load_model(self.model).tracks[self.track]
        interval = self.share.interval
        return {
            "scene": self.group.scene_name,
            "variant": self.group.variant,
            "model": self.model,
            "training": self.training,
            "train_engines": ",".join(self.share.engines),
            "seed": str(self.seed),
            "track": self.track,
            "settings": msgspec.json.encode(settings).decode(),
            "profile": msgspec.json.encode(self.profile).decode(),
            "data": json.dumps({e: _content(self.group, e) for e in self.share.engines}),
            "starts": _starts(self),
            "drawn": json.dumps(self.group.drawn),
            **({"interval": interval} if interval else {}),
        }


def check_data(run: TrainingRun) -> None:
    """Refuse a run that its data are too few or too short for, before any is started.

    Raises:
        InputError: A part has no trajectory for it, or no window fits in.
    """
    for split in ("train", "validation"):
        check_share(run.group, run.share, split)
    data = next(iter(run.group.data.values()))
    frames, needed = int(data.attributes["steps"]) + 1, HISTORY + recipe_of(run).horizon
    if frames < needed:
        msg = (
            f"{data.path}: got trajectories of {frames} frames, {run.model} in the track "
            f"{run.track} needs at least {needed}; generate longer ones"
        )
        raise InputError(msg)


def finished(run: TrainingRun) -> dict[str, str] | None:
    """Give the facts of a run that has been carried out, or None where it is still to be.

    Raises:
        InputError: There are files of another run in its place.
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
    """Make the untrained model of a run, and read its data.

    Args:
        run: Which one.
        most: Only so many trajectories of each part.
    """
    kind = load_model(run.model)
    training, validation = (
        mixed(
            run.group,
            run.share,
            split,
            bodies=kind.needs_bodies,
            device=run.device,
            dtype=kind.dtype,
            most=most,
        )
        for split in ("train", "validation")
    )
    statistics = Statistics.of(training)
    graph = training.graph.to("cpu")
    model = build(run.model, graph, statistics, track=run.track, seed=run.seed)
    put(model, run.device)
    return model, statistics, (training, validation)


def recipe_of(run: TrainingRun) -> Recipe:
    """Give the optimiser's settings of a run's track."""
    recipe: Recipe = load_model(run.model).tracks[run.track].recipe
    return recipe


def carry_out(run: TrainingRun) -> dict[str, str]:
    """Train, or go on, and write the files; called in a process of its own.

    Returns:
        The facts of the model's file.
    """
    torch.set_num_threads(1)
    known = finished(run)
    if known is not None:
        return known
    model, statistics, parts = prepared(run)
    run.checkpoint.parent.mkdir(parents=True, exist_ok=True)
    with EventLog(run.events and run.events / run.name) as log:

        def tell(training: Training) -> None:
            _write_curve(run, training)
            log.add(training.curve[-1])

        training = train(
            model,
            *parts,
            recipe_of(run),
            run.profile,
            seed=run.seed,
            checkpoint=run.checkpoint,
            tell=tell,
            identity=run.identity,
        )
    _write_curve(run, training)
    facts = {**run.identity, **facts_of(run, training, parts)}
    settings = load_model(run.model).tracks[run.track]
    save_model(run.path, model, run.model, settings, statistics, **facts)
    run.checkpoint.unlink(missing_ok=True)
    return facts


def _write_curve(run: TrainingRun, training: Training) -> None:
    whole = LearningCurve(run.name, run.profile.steps, training.ended, training.curve)
    write_whole(run.curve, write_curve(whole))


def facts_of(run: TrainingRun, training: Training, parts: Parts) -> dict[str, str]:
    """What is to be known of a run besides its identity, as text."""
    steps = training.curve[-1].step
    told = {
        "profile_name": run.profile_name,
        "engines": ",".join(run.group.files),
        "files": json.dumps({e: _place(run.group.files[e]) for e in run.share.engines}),
        "train_trajectories": len(parts[0]),
        "validation_trajectories": len(parts[1]),
        "steps": steps,
        "skipped_steps": training.skipped,
        "ended": training.ended,
        "level": "yes" if _is_level(training, run.profile) else "no",
        "last_improvement": training.last_improvement,
        "best_error": training.best.error,
        "best_step": training.best.step,
        "wall_s": training.wall_s,
        "cpu_s": training.cpu_s,
        "steps_per_s": steps / training.wall_s,
        "device": run.device,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "mbds_xsim": version("mbds-xsim"),
    }
    return {key: str(value) for key, value in told.items()}


def _is_level(training: Training, profile: Profile) -> bool:
    """Whether the last fifth of the steps improved validation too little to go on."""
    enough = len(training.curve) >= profile.least and training.ended != "diverged"
    return enough and training.last_improvement < profile.improvement


def _place(path: Path) -> str:
    """A file within the data, wherever these are, as in `6pendulum/mujoco-native.h5`."""
    return f"{path.parent.name}/{path.name}"


def _content(group: TrainingGroup, engine: str) -> str:
    found: str = group.data[engine].attributes[CONTENT]
    return found


def _starts(run: TrainingRun) -> str:
    """Checksum of the trajectories' numbers: they depend on what all engines of the group have."""
    whole = hashlib.sha256()
    for split in ("train", "validation"):
        whole.update(run.share.numbers(run.group, split).astype("<i8").tobytes() + b"|")
    return whole.hexdigest()


_FEW = 32  # trajectories to try it on
_WARM = 3  # steps: the first ones make what later ones reuse
_STEPS = 20
_LONGEST = 5.0  # [s] of trying


@dataclass(frozen=True)
class Cost:
    """Of one run of a model on one scene, as it is trained here."""

    group: str
    model: str
    steps_per_s: float
    validation_s: float
    """Of one validation [s]."""
    hours: float
    """Of a run that takes all its steps [h]; it may end before where validation is level."""


def measure(run: TrainingRun) -> Cost:
    """Try a few steps and a validation; called in a process of its own."""
    torch.set_num_threads(1)
    model, _, (training, validation) = prepared(run, most=_FEW)
    profile = msgspec.structs.replace(run.profile, until_level=False)

    def seconds(steps: int, judged: Motions, windows: int) -> float:
        """Time of so many steps with a validation of so many windows."""
        few = msgspec.structs.replace(profile, steps=steps, every=steps, windows=windows)
        return _timed(lambda: train(model, training, judged, recipe_of(run), few))

    one = seconds(_WARM, validation, 1) / _WARM
    steps = max(1, min(_STEPS, round(_LONGEST / one)))
    step_s = seconds(steps, validation[:1], 1) / steps
    # As many as a validation of the run has, though of few trajectories.
    windows = min(run.profile.windows, len(run.share.numbers(run.group, "validation")))
    many = Motions.joined([validation] * math.ceil(windows / len(validation)))
    seconds(1, many, windows)  # compiles what is of this size
    validation_s = max(0.0, seconds(1, many, windows) - step_s)
    validations = math.ceil(run.profile.steps / run.profile.every)
    return Cost(
        group=run.group.name,
        model=run.model,
        steps_per_s=1.0 / step_s,
        validation_s=validation_s,
        hours=(run.profile.steps * step_s + validations * validation_s) / 3600.0,
    )


def _timed(work: Callable[[], Training]) -> float:
    begin = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - begin
