"""Trained models on the axes of the engines.

A model has no step to choose: it takes its frame. It is shown the reference's first six frames and
predicts the rest of the study's time; what it tells are positions of particles, and by these alone
it is judged, with the limits that engines are held to. The scene is the study's, whatever the model
was trained on: its parameters are those of a network that fits any graph.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Task
from mbds_xsim.base.versions import CHECKS, MODELS
from mbds_xsim.learn.model_file import read_model
from mbds_xsim.learn.particles import (
    ParticleMotion,
    gap,
    particle_error,
    sunk,
    unexplained_energy,
    way,
)
from mbds_xsim.learn.trained import (
    TrainedModel,
    carry_on,
    known_start,
    particle_motion,
    trained_in,
)
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.measure.identity import machine
from mbds_xsim.reference.cache import key_of
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.studies.stability.definition import Case, Study, Value
from mbds_xsim.studies.stability.rows import LEARNED, Options, Outcome
from mbds_xsim.studies.stability.verdict import Judged, Signs, Verdict, part_of_way

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LearnedContender:
    """A trained model; see `Contender`."""

    trained: TrainedModel

    @property
    def engine(self) -> str:
        """Name of the model."""
        return self.trained.kind

    @property
    def method(self) -> str:
        """What it was trained on."""
        return f"{self.trained.scene.name}-{self.trained.run}"

    @property
    def profile(self) -> Profile:
        """Of its data."""
        return cast(Profile, self.trained.variant)

    @property
    def name(self) -> str:
        """Model, training and profile."""
        return f"{self.engine} {self.method}" + (" native" if self.profile == "native" else "")

    @property
    def source(self) -> str:
        """Where it is, as it was named."""
        return str(self.trained.named)

    @property
    def version(self) -> str:
        """Of what runs it."""
        return registry.package_version("torch")

    @property
    def versions(self) -> dict[str, str]:
        """Of what runs it."""
        return {"torch": self.version}

    @property
    def family(self) -> str:
        """None of the engines'."""
        return LEARNED

    def clock(self, study: Study) -> Clock:
        """Give its own frames over the study's time."""
        frame = self.trained.scene.clock.frame
        return Clock(frame, max(HISTORY, round(study.clock.duration / frame)))

    def counts(self, asked: Sequence[int]) -> tuple[int, ...]:
        """Give one: it has no steps."""
        del asked
        return (1,)

    def refusal(self, study: Study, scene: Scene) -> str:
        """Try whether its parameters fit, and whether anything can be given to it."""
        if not study.known:
            return f"{self.name}: no reference is known that could give it its first frames"
        try:
            read_model(self.trained.file, scene)
        except InputError as error:
            return str(error)
        return ""

    def options(self, scene: Scene) -> Options:
        """Give none."""
        del scene
        return {}

    def key(self, case: Case, count: int) -> str:
        """Hash file, motion, versions and machine."""
        motion = key_of("learned", case.scene, case.batch, 0, 0.0)
        versions = (MODELS, CHECKS, self.version)
        what = (self.trained.content, motion, count, versions, machine())
        return hashlib.sha256(repr(what).encode()).hexdigest()

    def group(self, value: Value) -> tuple[Value, ...]:
        """Put all values together: torch takes longer to start than a prediction."""
        del value
        return (self.name,)

    def task(self, cells: Sequence[tuple[Case, int]], limit: float) -> Task:
        """Predict and judge."""
        cases = [(case.scene, case.batch, case.truth) for case, _ in cells]
        return Task(run_models, (self.trained.file, cases, limit / 2.0), limit)


def models_in(places: Sequence[Path]) -> tuple[LearnedContender, ...]:
    """Find trained models in files and folders.

    Raises:
        InputError: There is none, or a file is no trained model.
    """
    return tuple(map(LearnedContender, trained_in(places)))


def run_models(
    path: Path, cases: Sequence[tuple[Scene, Batch, Trajectory | None]], patience: float
) -> list[Judged]:
    """Predict starts in turn, as many as are begun within a time [s]; see `run_model`."""
    begin = time.process_time()
    done: list[Judged] = []
    for case in cases:
        if done and time.process_time() - begin > patience:
            break
        done.append(run_model(path, *case))
    return done


def run_model(path: Path, scene: Scene, batch: Batch, truth: Trajectory | None) -> Judged:
    """Predict one start in this process and judge it; the time is that of the frames predicted.

    Raises:
        InputError: The parameters do not fit, or no reference gives the first frames.
    """
    import torch

    torch.set_num_threads(1)
    if truth is None:
        msg = f"no reference is known here that could give a model its first {HISTORY} frames"
        raise InputError(msg)
    model, _ = read_model(path, scene)
    known = known_start(model, truth, batch)
    begin = time.perf_counter()
    predicted = carry_on(model, known)
    wall = time.perf_counter() - begin
    motion = particle_motion(model.graph, batch, truth, predicted)
    return Judged(judge_particles(motion, particle_motion(model.graph, batch, truth)), wall)


def judge_particles(motion: ParticleMotion, truth: ParticleMotion) -> Verdict:
    """Judge one motion by its particles, with the limits of `verdict`.

    Nothing tells that a prediction is wrong: models have no words for it.
    """
    length, frame = motion.graph.length, motion.graph.frame_s
    with np.errstate(all="ignore"):
        signs = Signs(
            unexplained_energy(motion, truth),
            gap(motion) / length,
            sunk(motion) / length,
            part_of_way(way(motion), way(truth), length),
            particle_error(motion, truth) / length,
        )
    finite = np.asarray(np.isfinite(motion.position).all(axis=(1, 2)))
    ended = len(finite) if finite.all() else int(finite.argmin())
    broken = {what: flags[HISTORY:] for what, flags in signs.broken().items()}
    broken["blows up"] = ~finite[HISTORY:]
    first = {what: int(flags.argmax()) + HISTORY for what, flags in broken.items() if flags.any()}
    first = first or signs.off_course()
    outcome: Outcome = min(first, key=lambda what: first[what]) if first else "stable"
    return Verdict(
        outcome=outcome,
        told="nobody",
        reason="",
        broke_s=first[outcome] * frame if first else None,
        ended_s=(ended - 1) * frame,
        **signs.figures(),
    )
