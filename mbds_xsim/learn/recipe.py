"""Settings of a training: optimiser, rate schedule, batch size, length, and device.

On a GPU, bfloat16 in the networks and networks replayed as CUDA graphs can be faster.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext

import msgspec
import torch
from torch import nn

from mbds_xsim.base import bounds
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import core_count
from mbds_xsim.learn.model import LearnedModel, PointModel


class Plateau(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Schedule that lowers the rate when the validation error stops falling."""

    patience: int = 3
    """Number of validations without improvement that are tolerated."""
    factor: float = 0.8


class Decay(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Exponential schedule: the rate falls from the recipe's towards a floor."""

    tenth: int = 5_000_000
    """Number of steps in which the part above the floor falls to a tenth."""
    floor: float = 1e-6

    def at(self, rate: float, step: int, steps: int) -> float:
        """Return the rate of a step, given the recipe's rate."""
        del steps
        return self.floor + (rate - self.floor) * 0.1 ** (step / self.tenth)


class Cosine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Half-cosine schedule: the rate falls to zero after the last step that a run may take.

    Source: Loshchilov and Hutter, SGDR, ICLR 2017, without restarts.
    """

    def at(self, rate: float, step: int, steps: int) -> float:
        """Return the rate of one of `steps` steps, given the recipe's rate."""
        return 0.5 * rate * (1.0 + math.cos(math.pi * step / steps))


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the optimiser Adam: its rate and schedule, batches, gradients."""

    rate: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    batch: int = 64
    """Number of windows per step."""
    horizon: int = 1
    """Number of frames to come in a window; GNS and SGNN learn from one, see `model.pushed`."""
    schedule: Plateau | Decay | Cosine | None = None
    clip: float | None = None
    """Largest norm of a gradient, to which longer ones are shortened; None: no limit."""
    skip: bool = False
    """Whether a step with a gradient that is not finite is skipped and the run goes on. A run that
    skips at least half of the steps between two validations has diverged."""

    def __post_init__(self) -> None:
        bounds.positive("rate", self.rate)
        bounds.at_least_one("batch", self.batch)
        bounds.at_least_one("horizon", self.horizon)


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Length of a training, and its validations."""

    steps: int
    """Maximum number of optimiser steps."""
    every: int
    """Number of steps between validations, each of which writes a checkpoint."""
    windows: int = 128
    """Number of validation trajectories that are predicted each time, always the same."""
    horizon: int = 10
    """Number of frames of each validation prediction."""
    until_level: bool = True
    """Whether to stop once the last fifth of the steps has improved validation too little."""
    improvement: float = 0.02
    """Relative improvement of the error below which a run is level."""
    least: int = 20
    """Least number of validations before such a stop: a fifth of fewer depends on a single one."""
    mixed_precision: bool = False
    """Whether networks of float32 models compute in bfloat16 on a GPU, where that is safe."""
    compiled: bool = False
    """Whether networks of float32 models are compiled on a GPU and replayed as CUDA graphs."""

    def __post_init__(self) -> None:
        for key in ("steps", "every", "windows", "horizon", "least"):
            bounds.at_least_one(key, getattr(self, key))

    def of_exactly(self, steps: int) -> Profile:
        """Return the profile of a run that takes exactly `steps` steps, level or not."""
        # Fewer than `least` validations could not show whether the run was level.
        every = max(1, min(self.every, steps // self.least))
        return msgspec.structs.replace(self, steps=steps, every=every, until_level=False)


PROFILES = {
    "smoke": Profile(steps=600, every=100, windows=32, until_level=False),
    "lite": Profile(steps=30_000, every=150),
    "paper": Profile(steps=1_000_000, every=5_000, windows=512),
}

TRACKS = {"smoke": "lite", "lite": "lite", "paper": "paper"}
"""Track of hyper-parameters of each profile."""

WITHOUT_END = Plateau(patience=3, factor=0.5)
"""Schedule of cosine recipes for runs that end when level: a cosine needs a last step."""

SETTLED = 1 / 32
"""Fraction of the recipe's rate to which plateaus must lower it before a run counts as level: at a
higher rate, validation errors fluctuate by more than they improve."""


def check_device(device: str, *, here: bool = True) -> None:
    """Raise InputError for an unknown device or, if `here`, for one that this machine lacks."""
    if device not in ("cpu", "cuda"):
        raise InputError(f"--device: got {device!r}, allowed is cpu or cuda")
    if here and device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device: got 'cuda', but torch finds no GPU here; allowed is cpu")


def process_count(workers: int | None, device: str) -> int:
    """Return the number of processes: as asked, else one for a GPU or one per core."""
    if workers is not None:
        return workers
    return 1 if device == "cuda" else core_count()


def put(model: LearnedModel, device: str) -> None:
    """Move a model and its graph to a device."""
    model.to(device)
    model.graph = model.graph.to(device)


def precision(model: LearnedModel, *, mixed: bool) -> AbstractContextManager[object]:
    """Return the context in which a loss is computed, in bfloat16 if `mixed` and the model allows.

    Parameters, optimiser and integration stay float32, and so do the sums and norms that torch
    keeps in it. bfloat16 has the range of float32, so gradients need no scaling.
    """
    if not (mixed and model.mixes):
        return nullcontext()
    return torch.autocast(next(model.parameters()).device.type, dtype=torch.bfloat16)


def compile_networks(model: LearnedModel, *, backend: str | None = None) -> None:
    """Compile a model's networks at their first use; its parameters keep their names.

    A run has few shapes (a batch, its parts in `model.pushed`, a validation), so the kernels of
    each are recorded once as a CUDA graph and replayed. Only a `PointModel` is compiled: for models
    of an energy, torch cannot compile through the second derivatives that their training needs.
    Backends other than torch's own use no CUDA graphs.
    """
    if not isinstance(model, PointModel):
        return
    options = {"mode": "reduce-overhead"} if backend is None else {"backend": backend}
    networks = [model] if _has_forward(model) else [*filter(_has_forward, model.children())]
    for network in networks:
        if any(True for _ in network.parameters()):
            network.compile(**options, dynamic=False)


def _has_forward(module: nn.Module) -> bool:
    return type(module).forward is not nn.Module.forward
