"""What training will cost, from a few steps of each model."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import torch

from mbds_xsim.learn.runs import Run, prepared, recipe_of
from mbds_xsim.learn.train import Training, train
from mbds_xsim.learn.window import Motions

__all__ = ["Cost", "measure"]

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


def measure(run: Run) -> Cost:
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
