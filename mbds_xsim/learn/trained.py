"""Trained models: the facts in their files, the choice of models to compare, and predictions.

A model needs the first frames of a motion. In comparisons with engines they are the reference's: it
starts where every engine starts, but knows how the motion begins, which no engine does.
"""

from __future__ import annotations

import glob
import hashlib
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.points import Points
from mbds_xsim.learn.graph import Graph, RowBundle
from mbds_xsim.learn.model import TRIVIAL, LearnedModel, load_model, roll
from mbds_xsim.learn.model_file import read_model, read_name
from mbds_xsim.learn.particles import ParticleMotion
from mbds_xsim.learn.plugins import in_a_line
from mbds_xsim.learn.window import HISTORY, KnownInputs, Start
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate.choice import words_of

_FACTS = ("train_engines", "variant", "training", "seed")
_ALIKE = ("profile", "track", "settings", "drawn", "starts", "device")
"""Facts that trainings must share if only their engines are to differ."""
_SPENT = ("wall_s", "cpu_s", "train_trajectories")
"""Numeric facts that studies report."""
_WAYS = ("each", "leave-one-out", "all", "by-interval")


@dataclass(frozen=True)
class TrainedModel:
    """Trained model as its file describes it, or a trivial one, which has no file."""

    model: str
    """Name that distinguishes it from other models: that of its folder."""
    training: str
    """Name and variant of the training: "mujoco-native", "all-matched"."""
    engines: tuple[str, ...]
    """Engines whose data it was trained on; empty for trivial models."""
    variant: str
    seed: int
    path: Path | None
    """Absolute path of its file; None for a trivial model."""
    content: str
    """Checksum of the file; the name of a trivial model."""
    profile: str = ""
    steps: int = 0
    """Number of optimiser steps; 0 if not stated."""
    ended: str = ""
    data: tuple[tuple[str, str], ...] = ()
    """Engines and checksums of the files that it was trained on, if stated."""
    drawn: tuple[int, int] | None = None
    """Seed and number of the drawn trajectories that include its training part, if stated."""
    interval: str = ""
    """Interval of the starts that it was trained on; empty for all."""
    bodies: bool = False
    """Whether it starts from the bodies' states, not from the particles' positions alone."""
    budget: tuple[tuple[str, str], ...] = ()
    """Facts that comparable trainings share, such as profile and starts, if stated."""
    facts: dict[str, str] = field(default_factory=dict, compare=False, repr=False)
    """All facts in the file."""
    trained_on: Scene | None = field(default=None, compare=False, repr=False)
    named: Path | None = field(default=None, compare=False, repr=False)
    """Path of its file as the user gave it: results must not contain paths of a machine."""

    @property
    def scene(self) -> Scene:
        """Scene that it was trained on, with its clock; trivial models have none."""
        assert self.trained_on is not None
        return self.trained_on

    @property
    def file(self) -> Path:
        """Path of its file; trivial models have none."""
        assert self.path is not None
        return self.path

    @property
    def kind(self) -> str:
        """Registered name of the model, whatever the name of its folder."""
        return self.facts.get("model") or self.model

    @property
    def run(self) -> str:
        """Name of the training, and the seed: "mujoco-s0"."""
        return f"{self.facts['training']}-s{self.seed}"

    @property
    def single(self) -> bool:
        """Whether it was trained on one engine's data."""
        return len(self.engines) == 1

    @property
    def domains(self) -> tuple[str, ...]:
        """Domains that it was trained on: engines and variant."""
        return tuple(f"{engine}-{self.variant}" for engine in self.engines)

    @property
    def way(self) -> str:
        """Word for `mbds-xsim train --on` that makes such a training."""
        if self.interval:
            return "by-interval"
        if self.training.startswith("not-"):  # even of two engines, where only the other is left
            return "leave-one-out"
        return "each" if self.single else "all"

    def load(self, scene: Scene) -> LearnedModel:
        """Load the model for data of a scene; raise InputError if it is of another scene."""
        if self.path is None:
            # Trivial models need no statistics.
            nothing: Any = None
            return load_model(self.model)(Graph.of(scene), nothing, None)
        self.check_scene(scene)
        return read_model(self.path)[0]

    @contextmanager
    def named_in_errors(self) -> Iterator[None]:
        """Raise InputError with the model's file for an error that its code raises."""
        try:
            yield
        except (InputError, MemoryError, torch.OutOfMemoryError):
            raise
        except Exception as error:
            msg = f"{self.path or self.model}: testing it failed: {in_a_line(error)}; repair it, "
            raise InputError(msg + "or remove its file") from error

    def check_scene(self, scene: Scene) -> None:
        """Raise InputError for data of another scene."""
        if self.trained_on != scene:
            msg = f"{self.path}: not trained on the scene of the data; train it on such data"
            raise InputError(msg)


def trained_model(path: Path) -> TrainedModel:
    """Read the facts of a model's file; raise InputError if it is none, or if facts are missing."""
    model, facts = read_model(path)
    missing = [key for key in _FACTS if not facts.get(key)]
    if missing:
        msg = f"{path}: does not say its {', '.join(missing)}; train it with mbds-xsim train"
        raise InputError(msg)
    try:
        seed, steps = int(facts["seed"]), int(facts.get("steps", 0))
        data = msgspec.json.decode(facts.get("data", "{}"), type=dict[str, str])
        drawn = msgspec.json.decode(facts.get("drawn", "null"), type=dict[str, int] | None)
        split = None if drawn is None else (drawn["seed"], drawn["trajectories"])
        interval = facts.get("interval", "")
        ("", *INTERVALS).index(interval)
        if not all(math.isfinite(float(facts.get(key) or 0)) for key in _SPENT):
            raise ValueError(_SPENT)
    except (ValueError, KeyError) as error:
        raise InputError(
            f"{path}: its seed, steps, times, data, interval or drawn are not what mbds-xsim train "
            "writes; train it again"
        ) from error
    return TrainedModel(
        model=path.parent.name,
        training=f"{facts['training']}-{facts['variant']}",
        engines=tuple(map(str.strip, facts["train_engines"].split(","))),
        variant=facts["variant"],
        seed=seed,
        path=path.resolve(),
        content=hashlib.sha256(path.read_bytes()).hexdigest(),
        profile=facts.get("profile_name") or facts.get("profile", ""),
        steps=steps,
        ended=facts.get("ended", ""),
        data=tuple(sorted(data.items())),
        drawn=split,
        interval=interval,
        bodies=model.needs_bodies,
        budget=tuple((key, facts[key]) for key in _ALIKE if key in facts),
        facts=facts | {"model": facts.get("model") or read_name(path)},
        trained_on=model.graph.scene,
        named=path,
    )


def trained_in(places: Sequence[Path]) -> list[TrainedModel]:
    """Find the models in files, in patterns of files, and in all files *.pt below folders, once.

    Raises InputError if a place has none, or if a file is not a trained model.
    """
    found: dict[Path, Path] = {}
    for place in places:
        if place.is_dir():
            paths = sorted(place.rglob("*.pt"))
        elif glob.has_magic(str(place)) and not place.exists():
            paths = sorted(map(Path, glob.glob(str(place))))
        else:
            paths = [place]
        if not paths:
            msg = f"{place}: no trained models (*.pt) there; make some with mbds-xsim train"
            raise InputError(msg)
        found |= {path.resolve(): path for path in paths}
    return [*map(trained_model, found.values())]


@dataclass(frozen=True)
class Selection:
    """Choice of the models and domains that take part; by default all do."""

    variants: tuple[str, ...] = ()
    ways: tuple[str, ...] = ()
    seeds: int | None = None
    """Number of seeds, from 0 on; None: all."""

    @staticmethod
    def parse(settings: str | None, on: str | None, seeds: int | None) -> Selection:
        """Parse a user's words; raise InputError with the allowed ways for an unknown one."""
        ways = words_of(on or (), "--on")
        if unknown := [way for way in ways if way not in _WAYS]:
            msg = f"--on: got {unknown[0]!r}, allowed is {', '.join(_WAYS)}, comma-separated"
            raise InputError(msg)
        return Selection(words_of(settings or (), "--settings"), ways, seeds)

    def has(self, model: TrainedModel) -> bool:
        """Whether a trained model takes part."""
        return (
            (not self.variants or model.variant in self.variants)
            and (not self.ways or model.way in self.ways)
            and (self.seeds is None or model.seed < self.seeds)
        )


WHOLE = Selection()


def find_models(folder: Path, scene: str, selection: Selection = WHOLE) -> list[TrainedModel]:
    """Find the files `<scene>/<variant>/<model>/<training>-s<seed>.pt` below a folder.

    Raises InputError if there is none, if one does not state its training, or if two are the same.
    """
    paths = sorted((folder / scene).glob("*/*/*-s*.pt"))
    if not paths:
        raise InputError(
            f"{folder / scene}: no trained models (<variant>/<model>/<training>-s<seed>.pt); make "
            "some with mbds-xsim train"
        )
    models = sorted(map(trained_model, paths), key=_order)
    known: dict[tuple[str, str, int], Path | None] = {}
    for model in models:
        key = (model.model, model.training, model.seed)
        if key in known:
            msg = f"{model.path} and {known[key]} are both {' '.join(map(str, key))}; remove one"
            raise InputError(msg)
        known[key] = model.path
    chosen = [model for model in models if selection.has(model)]
    if not chosen:
        ways = ", ".join(dict.fromkeys(f"{m.way} {m.variant}" for m in models))
        seeds = ", ".join(map(str, sorted({m.seed for m in models})))
        raise InputError(
            f"{folder / scene}: none of the {len(models)} models there is selected; there are "
            f"{ways}, of seed {seeds}"
        )
    return chosen


def trivial_models() -> list[TrainedModel]:
    """Return the models that learn nothing."""
    return [TrainedModel(name, "nothing", (), "", 0, None, name) for name in TRIVIAL]


def check_budget(models: Sequence[TrainedModel]) -> None:
    """Raise InputError if models of one kind differ in more than their engines and variant."""
    firsts: dict[tuple[str, ...], tuple[str, TrainedModel]] = {}
    for model in models:
        for key, value in model.budget:
            # Starts depend on the trajectories that all engines of a variant have.
            group = (model.variant, model.interval) if key == "starts" else ()
            usual, first = firsts.setdefault((model.model, key, *group), (value, model))
            if value != usual:
                raise InputError(
                    f"{model.path}: has another {key} than {first.path}; comparing them would "
                    "show that, not engines: train both alike, or remove one"
                )


def _order(model: TrainedModel) -> tuple[str, str, int, int, str, int]:
    """Return a sort key: single engines, leave-one-out, all, single intervals, for each variant."""
    part = ("", *INTERVALS).index(model.interval)
    return model.model, model.variant, part, len(model.engines), model.training, model.seed


@dataclass(frozen=True, eq=False)
class Known(RowBundle):
    """Known part of motions: their first frames, and the inputs of the frames to come."""

    start: Start
    inputs: KnownInputs

    def repeated(self, rows: int) -> Known:
        """Return a batch of `rows` rows, which repeats these."""
        return self[torch.arange(rows) % len(self)]

    def truncated(self, frames: int) -> Known:
        """Keep the inputs of only the first `frames` frames to come."""
        return Known(self.start, self.inputs[:, :frames])


def known_start(model: LearnedModel, truth: Trajectory, inputs: Batch) -> Known:
    """Return the first `HISTORY` frames of the reference as a model's start.

    Args:
        model: A model on the CPU.
        truth: Solution of some starts, with one frame more than there are inputs; InputError if it
            is too short.
        inputs: Known inputs, without the random forces.
    """
    graph, last = model.graph, HISTORY - 1
    if inputs.steps < HISTORY:
        msg = f"{inputs.steps + 1} frames: a model is shown {HISTORY} and predicts what follows"
        raise InputError(msg)
    if not np.isfinite(truth.position[:, :HISTORY]).all():
        msg = f"the reference, which gives a model its first {HISTORY} frames, ends before them"
        raise InputError(msg)
    position, velocity = (torch.from_numpy(part) for part in Points.of(graph.scene).motion(truth))
    body = np.concatenate([getattr(truth, name)[:, :HISTORY] for name in STATES], axis=-1)
    return Known(
        Start(
            history=graph.embed(position[:, :HISTORY].to(model.dtype)),
            velocity=graph.embed(velocity[:, last].to(model.dtype), rest=0.0),
            body=torch.from_numpy(body),
        ),
        KnownInputs(
            torch.from_numpy(inputs.force[:, last:]).to(model.dtype),
            torch.from_numpy(inputs.torque[:, last:]).to(model.dtype),
        ),
    )


def carry_on(model: LearnedModel, known: Known) -> torch.Tensor:
    """Predict positions in all frames to come [m], shape (trajectory, frame, particle, 3)."""
    with torch.no_grad():
        return roll(model, known.start, known.inputs)


def particle_motion(
    graph: Graph, start: Batch, truth: Trajectory, predicted: torch.Tensor | None = None
) -> ParticleMotion:
    """Return the particles of one motion: the reference's, or predictions after its first frames.

    Predictions are as `carry_on` returns them [m], shape (1, frame, particle, 3).
    """
    position, _ = Points.of(graph.scene).motion(truth)
    frames = graph.embed(torch.from_numpy(position))[0]
    if predicted is not None:
        frames = torch.cat([frames[:HISTORY], predicted[0].double()])
    return ParticleMotion(graph, start, frames.numpy())
