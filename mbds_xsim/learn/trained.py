"""Trained models as contenders beside engines: which there are, and rollouts from a known start.

A model needs the first frames of a motion. They are the reference's, so that it starts where every
engine starts, and knows what no engine is told: how the motion begins.
"""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mbds_xsim.dataset.points import Points
from mbds_xsim.errors import InputError
from mbds_xsim.learn.model import Model
from mbds_xsim.learn.rollout import roll
from mbds_xsim.learn.saved import read_model
from mbds_xsim.learn.shift.roster import Entry, entry_of
from mbds_xsim.learn.window import HISTORY, Inputs, Start
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory

__all__ = [
    "Known",
    "Trained",
    "carry_on",
    "known_start",
    "trained_in",
    "true_motion",
    "whole_motion",
]

Array = NDArray[np.float64]

_STATES = ("position", "orientation", "velocity", "angular_velocity")


@dataclass(frozen=True)
class Trained:
    """A trained model's file."""

    entry: Entry
    scene: Scene
    """That it was trained on, with its clock."""
    facts: dict[str, str]
    named: Path
    """Its file as it was named: in results no paths of a machine are to stand."""

    @property
    def path(self) -> Path:
        """Where it is, absolute."""
        assert self.entry.path is not None
        return self.entry.path

    @property
    def model(self) -> str:
        """By which it is told from others."""
        return self.facts.get("model") or self.entry.model

    @property
    def training(self) -> str:
        """What it was trained on, and its seed: "mujoco-s0"."""
        return f"{self.facts['training']}-s{self.entry.seed}"


def trained_in(places: Sequence[Path]) -> list[Trained]:
    """Find the models of files, of patterns of files, and of all files *.pt below folders.

    Raises:
        InputError: There is none, or a file is no trained model.
    """
    found = []
    for place in places:
        paths = _files(place)
        if not paths:
            msg = f"{place}: no trained models (*.pt) there; make some with mbds-xsim train"
            raise InputError(msg)
        found += [_trained(path) for path in paths]
    return found


def _files(place: Path) -> list[Path]:
    if place.is_dir():
        return sorted(place.rglob("*.pt"))
    pattern = glob.has_magic(str(place)) and not place.exists()
    return sorted(map(Path, glob.glob(str(place)))) if pattern else [place]


def _trained(path: Path) -> Trained:
    model, facts = read_model(path)
    return Trained(entry_of(path), model.graph.scene, facts, path)


@dataclass(frozen=True, eq=False)
class Known:
    """What a model is given of motions: their first frames, and the inputs of those to come."""

    start: Start
    inputs: Inputs

    def repeated(self, rows: int) -> Known:
        """Make a batch of so many out of few, with repetition."""
        chosen = torch.arange(rows) % len(self.start)
        return Known(self.start[chosen], self.inputs[chosen])

    def truncated(self, frames: int) -> Known:
        """Keep the inputs of the first frames to come."""
        force, torque = self.inputs.force[:, :frames], self.inputs.torque[:, :frames]
        return Known(self.start, Inputs(force, torque))


def known_start(model: Model, truth: Trajectory, inputs: Batch) -> Known:
    """Give a model the first `HISTORY` frames of the reference.

    Args:
        model: On the CPU.
        truth: Solution of some starts, of one frame more than there are inputs.
        inputs: What acts and is known: without the random forces.

    Raises:
        InputError: The reference ends before, or nothing is left to predict.
    """
    graph, last = model.graph, HISTORY - 1
    if inputs.steps < HISTORY:
        msg = f"{inputs.steps + 1} frames: a model is shown {HISTORY} and predicts what follows"
        raise InputError(msg)
    if not np.isfinite(truth.position[:, :HISTORY]).all():
        msg = f"the reference, which gives a model its first {HISTORY} frames, ends before them"
        raise InputError(msg)
    position, velocity = (torch.from_numpy(part) for part in Points.of(graph.scene).motion(truth))
    body = np.concatenate([getattr(truth, name)[:, last] for name in _STATES], axis=-1)
    return Known(
        Start(
            history=graph.embed(position[:, :HISTORY].to(model.dtype)),
            velocity=graph.embed(velocity[:, last].to(model.dtype), rest=0.0),
            body=torch.from_numpy(body),
        ),
        Inputs(
            torch.from_numpy(inputs.force[:, last:]).to(model.dtype),
            torch.from_numpy(inputs.torque[:, last:]).to(model.dtype),
        ),
    )


def carry_on(model: Model, known: Known) -> torch.Tensor:
    """Predict all frames to come [m], shape (trajectory, frame, particle, 3)."""
    with torch.no_grad():
        return roll(model, known.start, known.inputs)


def whole_motion(model: Model, truth: Trajectory, predicted: torch.Tensor) -> Array:
    """Put predictions behind the frames that were given [m], (trajectory, frame, particle, 3)."""
    return np.concatenate(
        [true_motion(model, truth)[:, :HISTORY], predicted.double().numpy()], axis=1
    )


def true_motion(model: Model, truth: Trajectory) -> Array:
    """Particles of the reference [m], shape (trajectory, frame, particle, 3)."""
    position, _ = Points.of(model.graph.scene).motion(truth)
    return np.asarray(model.graph.embed(torch.from_numpy(position)).numpy())
