"""How a model is trained: optimiser, schedule of its rate, batch; for how long, and on what device.

A GPU can be faster with bfloat16 in the networks, and with networks replayed as CUDA graphs.
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
    """Lower the rate where the validation loss stops falling."""

    patience: int = 3
    """Validations without improvement that are waited for."""
    factor: float = 0.8


class Decay(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Lower the rate exponentially, from the recipe's to a tenth and on, never below a floor."""

    tenth: int = 5_000_000
    """Steps in which the part above the floor falls to a tenth."""
    floor: float = 1e-6

    def at(self, rate: float, step: int, steps: int) -> float:
        """Rate of a step, from the recipe's."""
        del steps
        return self.floor + (rate - self.floor) * 0.1 ** (step / self.tenth)


class Cosine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Lower the rate along half a cosine, to zero behind the last step a run may take.

    Source: Loshchilov and Hutter, SGDR, ICLR 2017, without restarts.
    """

    def at(self, rate: float, step: int, steps: int) -> float:
        """Rate of a step of so many, from the recipe's."""
        return 0.5 * rate * (1.0 + math.cos(math.pi * step / steps))


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Adam, its rate and what becomes of it."""

    rate: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    batch: int = 64
    """Windows a step."""
    horizon: int = 1
    """Frames to come in a window. GNS and SGNN learn from one of them, see `model.pushed`."""
    schedule: Plateau | Decay | Cosine | None = None
    clip: float | None = None
    """Largest norm of a gradient; longer ones are shortened to it."""
    skip: bool = False
    """Whether a step whose gradient is no number is not taken, and the run goes on. One of which
    that is most steps since a validation has diverged."""

    def __post_init__(self) -> None:
        bounds.positive("rate", self.rate)
        bounds.at_least_one("batch", self.batch)
        bounds.at_least_one("horizon", self.horizon)


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How long to train, and how to watch it."""

    steps: int
    """Of the optimiser, at most."""
    every: int
    """Steps from a validation to the next, and from a checkpoint to the next."""
    windows: int = 128
    """Trajectories of the validation part that are predicted each time, always the same."""
    horizon: int = 10
    """Frames of such a prediction."""
    until_level: bool = True
    """Whether to stop once the last fifth of the steps has improved validation too little."""
    improvement: float = 0.02
    """What is too little, as a part of the error."""
    least: int = 20
    """Validations before the first such stop: a fifth of fewer is at the mercy of one of them."""
    mixed_precision: bool = False
    """On a GPU: networks of float32 models compute in bfloat16 where that is safe."""
    compiled: bool = False
    """On a GPU: networks of float32 models are compiled and replayed as CUDA graphs."""

    def __post_init__(self) -> None:
        for key in ("steps", "every", "windows", "horizon", "least"):
            bounds.at_least_one(key, getattr(self, key))

    def of_exactly(self, steps: int) -> Profile:
        """Give the profile of a run that takes all of so many steps, level or not."""
        # Fewer validations than the least could not tell whether it was level.
        every = max(1, min(self.every, steps // self.least))
        return msgspec.structs.replace(self, steps=steps, every=every, until_level=False)


PROFILES = {
    "smoke": Profile(steps=600, every=100, windows=32, until_level=False),
    "lite": Profile(steps=30_000, every=150),
    "paper": Profile(steps=1_000_000, every=5_000, windows=512),
}

TRACKS = {"smoke": "lite", "lite": "lite", "paper": "paper"}
"""Hyper-parameters that belong to a profile."""

WITHOUT_END = Plateau(patience=3, factor=0.5)
"""In place of a cosine where a run ends when it is level: it has no last step to end at."""

SETTLED = 1 / 32
"""Part of the recipe's rate to which plateaus must have lowered it before a run counts as level:
at a higher rate validation wavers by more than it improves."""


def check_device(device: str, *, here: bool = True) -> None:
    """Raise InputError for a device that is not known or, if it is to be here, is not there."""
    if device not in ("cpu", "cuda"):
        msg = f"--device: got {device!r}, allowed is cpu or cuda"
        raise InputError(msg)
    if here and device == "cuda" and not torch.cuda.is_available():
        msg = "--device: got 'cuda', but torch finds no GPU here; allowed is cpu"
        raise InputError(msg)


def process_count(asked: int | None, device: str) -> int:
    """As many at a time as asked; left out, one for a GPU, which they would share, or all cores."""
    if asked is not None:
        return asked
    return 1 if device == "cuda" else core_count()


def put(model: LearnedModel, device: str) -> None:
    """Move a model, and the graph that it asks in every step."""
    model.to(device)
    model.graph = model.graph.to(device)


def precision(model: LearnedModel, *, mixed: bool) -> AbstractContextManager[object]:
    """Give the block in which a model's loss is computed, mixed where it is asked for and can be.

    Parameters, optimiser and integration stay float32, and so do the sums and norms that torch
    keeps there. bfloat16 has float32's range: no gradient needs scaling.
    """
    if not (mixed and model.mixes):
        return nullcontext()
    return torch.autocast(next(model.parameters()).device.type, dtype=torch.bfloat16)


def compile_networks(model: LearnedModel, *, backend: str | None = None) -> None:
    """Have a model's networks compiled at their first use; its parameters keep their names.

    A run has few shapes (a batch, its parts that are pushed on, a validation), so that the kernels
    of each are recorded once, as a CUDA graph, and replayed. Models of an energy are left as they
    are: torch does not compile through the second derivatives that their training needs. Another
    backend than torch's own is without CUDA graphs.
    """
    if not isinstance(model, PointModel):
        return
    how = {"mode": "reduce-overhead"} if backend is None else {"backend": backend}
    networks = [model] if _has_forward(model) else [*filter(_has_forward, model.children())]
    for network in networks:
        if any(True for _ in network.parameters()):
            network.compile(**how, dynamic=False)


def _has_forward(module: nn.Module) -> bool:
    return type(module).forward is not nn.Module.forward
