"""Trained models as simulators, next to engines in `tradeoff` and `stability`.

A model has no step size to choose: its step is its frame. It sees the first frames of the reference
and, as in training, no random forces, and predicts the rest. It returns only positions of particles
and is judged by these alone. It may run on another scene than the one that it was trained on, if
its parameters fit the graph of that scene.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from mbds_xsim.base import isolate
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.versions import MODELS
from mbds_xsim.learn.model_file import read_model
from mbds_xsim.learn.particles import (
    ParticleMotion,
    gap,
    particle_error,
    sunk,
    unexplained_energy,
    way,
)
from mbds_xsim.learn.trained import TrainedModel, carry_on, known_start, particle_motion, trained_in
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.simulate.simulator import (
    LEARNED,
    NATIVE,
    Options,
    Signs,
    Simulated,
    Simulator,
    part_of_way,
)
from mbds_xsim.simulate.timed import WARM_UP, stopwatch

_TIMED = 25  # frames of a timed batch
_ENERGY = 2  # version of the figures of energy in scenes with contact, apart from MODELS


@dataclass(frozen=True)
class LearnedSimulator(Simulator):
    """Trained model as a simulator."""

    _: KW_ONLY
    trained: TrainedModel
    together: int = 1
    """Number of trajectories in a batch; each is charged an equal share of its time."""
    quiet: Batch | None = None
    """Starts of a study without the random forces; None if the study has none."""

    @classmethod
    def of(cls, trained: TrainedModel, training: str, **fields: Any) -> LearnedSimulator:
        """Wrap a trained model; `training` says in a study's words what it was trained on."""
        return cls(
            trained.kind,
            training,
            trained=trained,
            profile=cast(Profile, trained.variant),
            source=str(trained.named),
            context=HISTORY,
            **fields,
        )

    @property
    def family(self) -> str:
        """Family of learned simulators, which no engine belongs to."""
        return LEARNED

    @property
    def package(self) -> str:
        """Name of the package that runs it."""
        return "torch"

    @property
    def version(self) -> str:
        """Version of torch."""
        return registry.package_version("torch")

    def clock(self, usual: Clock) -> Clock:
        """Return a clock with the model's own frame over the usual duration."""
        frame = self.trained.scene.clock.frame
        return Clock(frame, max(HISTORY, round(usual.duration / frame)))

    def refusal(self, scene: Scene) -> str:
        """Return why the model's parameters do not fit a scene, or "" if they do."""
        try:
            read_model(self.trained.file, scene)
        except InputError as error:
            return str(error)
        return ""

    def options(self, scene: Scene) -> Options:
        """Return the number of frames that the model is shown, and its file's checksum."""
        del scene
        return {"known_frames": HISTORY, "file": self.trained.content[:16]}

    def decisive(self, scene: Scene, count: int) -> list[Any]:
        """List the model's file, the number of steps per frame, the batch size, and versions."""
        energy = [_ENERGY] if scene.contacts else []
        return [self.trained.content, count, self.together, MODELS, *energy, self.version]

    def simulate(
        self, scene: Scene, start: Batch, count: int, truth: Trajectory | None, *, often: bool
    ) -> Simulated:
        """Predict one start, and time it alone or in a batch of copies."""
        del count
        torch.set_num_threads(1)
        isolate.begin()
        if truth is None:
            msg = f"no reference is known here to give the model its first {HISTORY} frames"
            raise InputError(msg)
        begin = time.perf_counter()
        model, _ = read_model(self.trained.file, scene)
        setup = time.perf_counter() - begin
        quiet = start
        if self.quiet is not None:
            quiet = self.quiet[np.flatnonzero(self.quiet.index == start.index[0])]
        known = batch = known_start(model, truth, quiet)
        if self.together > 1:
            batch = known.repeated(self.together).truncated(_TIMED)
        if often:
            carry_on(model, batch.truncated(WARM_UP))
        predicted, wall, cpu = stopwatch(lambda: carry_on(model, batch), often=often)
        if batch is not known:
            predicted = carry_on(model, known)
        motion = particle_motion(model.graph, quiet, truth, predicted)
        rows, frames = batch.inputs.force.shape[:2]
        return Simulated(
            signs_of(motion, particle_motion(model.graph, start, truth)),
            wall,
            cpu,
            simulated_s=rows * frames * model.graph.frame_s,
            setup_s=setup,
        )


def signs_of(motion: ParticleMotion, truth: ParticleMotion) -> Signs:
    """Compute the signs of a predicted motion from its particles."""
    length, frame = motion.graph.length, motion.graph.frame_s
    finite = np.asarray(np.isfinite(motion.position).all(axis=(1, 2)))
    with np.errstate(all="ignore"):
        return Signs(
            time=np.asarray(frame * np.arange(len(finite)), dtype=np.float64),
            finite=np.logical_and.accumulate(finite),
            energy=unexplained_energy(motion, truth),
            gap=gap(motion) / length,
            sunk=sunk(motion) / length,
            way=part_of_way(way(motion), way(truth), length),
            error=particle_error(motion, truth) / length,
            begin=HISTORY,
        )


def simulators_in(places: Sequence[Path]) -> tuple[LearnedSimulator, ...]:
    """Find trained models in files and folders, for scenes of any kind.

    Raises:
        InputError: There is none, or a file is not a trained model.
    """
    return tuple(
        LearnedSimulator.of(
            trained,
            f"{trained.scene.name}-{trained.run}",
            variation=NATIVE if trained.variant == "native" else "",
        )
        for trained in trained_in(places)
    )
