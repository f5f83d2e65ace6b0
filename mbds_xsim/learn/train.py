"""Train a model: a fixed number of steps, or until validation no longer improves.

Only the validation part decides on rates, on the best parameters and on the end. An interrupted run
resumes from its checkpoint and ends with the same bits.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import torch
from torch import Tensor

from mbds_xsim.base.errors import InputError
from mbds_xsim.learn.model import LearnedModel, roll
from mbds_xsim.learn.model_file import array, arrays, read_stored, write_stored
from mbds_xsim.learn.plugins import located_in
from mbds_xsim.learn.recipe import (
    SETTLED,
    WITHOUT_END,
    Cosine,
    Decay,
    Plateau,
    Profile,
    Recipe,
    compile_networks,
    precision,
)
from mbds_xsim.learn.window import HISTORY, Motions, Sample

_ANEW = "remove it to start over"
_KEPT = ("curve", "ended", "skipped", "wall_s", "cpu_s")  # fields saved in a checkpoint
_LINE = 80  # longest list of differences that a message shows [characters]
_ABSENT = "absent"
End = Literal["", "steps", "level", "diverged"]
"""Reason why a training ended; empty while it goes on."""


class CurvePoint(msgspec.Struct, frozen=True):
    """A point of a learning curve."""

    step: int
    loss: float
    """Mean loss over the steps since the last point."""
    error: float
    """Mean squared position error of the validation predictions [m²]; infinite if one failed."""
    rate: float


@dataclass(eq=False)
class Training:
    """Run in progress or finished; at the end its model has the best parameters."""

    model: LearnedModel
    curve: list[CurvePoint] = field(default_factory=list)
    ended: End = ""
    """Reason for the end; "diverged" if losses were not finite at the last point of the curve."""
    skipped: int = 0
    """Number of steps that were skipped because they failed or had no finite gradient."""
    wall_s: float = 0.0
    """Time spent on it, in all processes that worked on it [s]."""
    cpu_s: float = 0.0
    """Processor time of these processes [s]."""

    @property
    def best(self) -> CurvePoint:
        """Point with the least error, whose parameters the model has at the end.

        If no error is finite, the model is as it was before the first step.
        """
        return min(self.curve, key=lambda point: point.error)

    @property
    def best_step(self) -> int:
        """Step of the best point; 0 if no error is finite."""
        return self.best.step if math.isfinite(self.best.error) else 0

    @property
    def last_improvement(self) -> float:
        """Relative improvement of the best error in the last fifth of the steps, 0 to 1.

        It is 1 if no error was finite before, because such a run has not become level.
        """
        before = [p.error for p in self.curve if p.step <= 0.8 * self.curve[-1].step]
        least = min(before, default=math.inf)
        if not math.isfinite(least):
            return 1.0
        return 1.0 - self.best.error / least if least > 0 else 0.0


def train(
    model: LearnedModel,
    training: Motions,
    validation: Motions,
    recipe: Recipe,
    profile: Profile,
    *,
    checkpoint: Path | None = None,
    tell: Callable[[Training], None] | None = None,
    identity: Mapping[str, str] | None = None,
    seed: int = 0,
) -> Training:
    """Train a model in place.

    Args:
        model: An untrained model, on the device of the motions.
        training: Trajectories from which windows are drawn.
        validation: Trajectories on which the model is judged.
        recipe: Optimiser and batch.
        profile: Length of the training.
        checkpoint: File to save to at every validation, and to resume from if it exists.
        tell: Called after every new point of the curve, after it is saved in the checkpoint.
        identity: Further facts that identify a run, besides seed, recipe and profile: its data.
        seed: Seed of the windows drawn and of the noise.

    Raises:
        InputError: The parts are not training and validation, or the checkpoint is of another run.
    """
    for motions, split in ((training, "train"), (validation, "validation")):
        if motions.split != split:
            raise InputError(f"train: got the part {motions.split!r}, allowed here is {split!r}")
    own = {"seed": str(seed), "recipe": repr(recipe), "profile": repr(profile)}
    loop = _Loop(model, recipe, profile, seed, {**own, **(identity or {})})
    if checkpoint is not None and checkpoint.exists():
        loop.restore(checkpoint)
    # The first trajectories from their first frames on, as tests predict them.
    rows = torch.arange(min(profile.windows, len(validation)), device=validation.position.device)
    horizon = min(profile.horizon, validation.frame_count - HISTORY)
    sample = validation.sample(rows, HISTORY - 1, horizon)
    device = sample.position.device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        while not loop.training.ended:
            with located_in(type(model)):
                loss = loop.learn(training)
            loop.judge(sample, loss)
            if checkpoint is not None:
                loop.save(checkpoint)
            if tell is not None:
                tell(loop.training)
    model.load_state_dict(loop.best_state)
    return loop.training


def optimiser(model: LearnedModel, recipe: Recipe) -> torch.optim.Adam:
    """Return a recipe's Adam; fused, since loops would cost a small model a tenth of its time."""
    parameters = model.parameters()
    return torch.optim.Adam(parameters, lr=recipe.rate, betas=recipe.betas, fused=True)


def validation_error(model: LearnedModel, sample: Sample) -> float:
    """Return the mean squared distance over trajectories, frames and particles [m²].

    It is infinite if a prediction failed.
    """
    model.eval()  # dropout and batch normalisation behave as in a test
    try:
        with torch.no_grad():
            predicted = roll(model, sample.start, sample.inputs)
    except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
        return math.inf
    error = float(((predicted - sample.position) ** 2).sum(-1).mean())
    return error if math.isfinite(error) else math.inf


class _Loop:
    """State of a training, and its steps."""

    def __init__(
        self,
        model: LearnedModel,
        recipe: Recipe,
        profile: Profile,
        seed: int,
        identity: dict[str, str],
    ) -> None:
        self.training = Training(model)
        self.recipe, self.profile, self.identity = recipe, profile, identity
        endless = profile.until_level and isinstance(recipe.schedule, Cosine)
        self.schedule = WITHOUT_END if endless else recipe.schedule
        self.clock = time.monotonic(), time.process_time()
        if profile.compiled and next(model.parameters()).is_cuda:
            compile_networks(model)
        self.seed, self.step, self.rate = seed, 0, recipe.rate
        self.best_state = copy.deepcopy(model.state_dict())
        self.generator = torch.Generator().manual_seed(seed)
        self.adam = optimiser(model, recipe)

    def learn(self, training: Motions) -> float:
        """Take steps until the next validation, and return the mean loss of those not skipped.

        It is NaN if at least half of them were skipped.
        """
        total, taken, skipped = torch.zeros((), device=training.position.device), 0, 0
        self.training.model.train()
        torch.manual_seed(self.seed + self.step)  # for dropout, also after an interruption
        for _ in range(min(self.profile.every, self.profile.steps - self.step)):
            sample = training.draw(self.recipe.batch, self.generator, self.recipe.horizon)
            try:
                loss = self._descend(sample)
            except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
                loss = None
            if loss is None:
                skipped += 1
            else:
                total += loss
                taken += 1
            self.step += 1
        self.training.skipped += skipped
        return float(total) / taken if taken > skipped else math.nan

    def _descend(self, sample: Sample) -> Tensor | None:
        """Take a step and return its loss; None if it is skipped."""
        self.adam.zero_grad()
        with precision(self.training.model, mixed=self.profile.mixed_precision):
            loss = self.training.model.loss(sample, self.generator)
        torch.autograd.backward(loss)
        clip, skip, schedule = self.recipe.clip, self.recipe.skip, self.schedule
        if skip or clip is not None:
            parameters = self.training.model.parameters()
            norm = torch.nn.utils.clip_grad_norm_(parameters, math.inf if clip is None else clip)
            if skip and not norm.isfinite():
                return None
        if isinstance(schedule, Decay | Cosine):
            self._set_rate(schedule.at(self.recipe.rate, self.step, self.profile.steps))
        self.adam.step()
        return loss.detach()

    def judge(self, sample: Sample, loss: float) -> None:
        """Validate, keep the best parameters, lower the rate, and decide whether the run ends."""
        model, curve = self.training.model, self.training.curve
        error = validation_error(model, sample) if math.isfinite(loss) else math.inf
        if error < min((point.error for point in curve), default=math.inf):
            self.best_state = copy.deepcopy(model.state_dict())
        curve.append(CurvePoint(self.step, loss, error, self.rate))
        before, self.clock = self.clock, (time.monotonic(), time.process_time())
        self.training.wall_s += self.clock[0] - before[0]
        self.training.cpu_s += self.clock[1] - before[1]
        if isinstance(self.schedule, Plateau):
            self._set_rate(_on_plateau(self.recipe.rate, self.schedule, curve))
        self.training.ended = self._end(loss)

    def _end(self, loss: float) -> End:
        training, profile = self.training, self.profile
        if not math.isfinite(loss):
            return "diverged"
        if self.step >= profile.steps:
            return "steps"
        by_plateau = isinstance(self.schedule, Plateau)
        settled = not by_plateau or self.rate <= SETTLED * self.recipe.rate
        long_enough = len(training.curve) >= profile.least
        level = settled and long_enough and training.last_improvement < profile.improvement
        return "level" if profile.until_level and level else ""

    def _set_rate(self, rate: float) -> None:
        self.rate = rate
        for group in self.adam.param_groups:
            group["lr"] = rate

    def save(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all."""
        state = {
            "identity": self.identity,
            "step": self.step,
            "rate": self.rate,
            "model": self.training.model.state_dict(),
            "best": self.best_state,
            "adam": self.adam.state_dict(),
            "generator": self.generator.get_state(),
            **{name: msgspec.to_builtins(getattr(self.training, name)) for name in _KEPT},
        }
        write_stored(path, state)

    def restore(self, path: Path) -> None:
        """Resume from a checkpoint."""
        state, model = read_stored(path, "checkpoint", _ANEW, _Checkpoint), self.training.model
        check_identity(path, "a checkpoint", state.identity, self.identity)
        try:
            model.load_state_dict(arrays(state.model))
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{path}: a checkpoint of another model; name another file") from error
        try:
            self.best_state = arrays(state.best)
            moments = {key: arrays(values) for key, values in state.adam["state"].items()}
            self.adam.load_state_dict({**state.adam, "state": moments})
            self.generator.set_state(array(state.generator))
        except Exception as error:  # a file can be wrong in any way
            raise InputError(f"{path}: no checkpoint, or a damaged one; {_ANEW}") from error
        self.step = state.step
        self._set_rate(state.rate)
        self.training = Training(model, **{name: getattr(state, name) for name in _KEPT})


class _Checkpoint(msgspec.Struct, frozen=True):
    """Content of a checkpoint's file; its arrays are still mapped from it."""

    identity: dict[str, str]
    step: int
    rate: float
    model: dict[str, Any]
    best: dict[str, Any]
    adam: dict[str, Any]
    generator: Any
    curve: list[CurvePoint]
    ended: End
    skipped: int
    wall_s: float
    cpu_s: float


def check_identity(
    path: Path, label: str, stated: Mapping[str, str], own: Mapping[str, str]
) -> None:
    """Raise InputError if a file is of another run, with the facts that differ.

    A file of an earlier version may state no device, and then fits any.
    """
    facts = [
        key + _entries_apart(stated.get(key, ""), own[key])
        for key in own
        if stated.get(key) != own[key] and (key in stated or key != "device")
    ]
    if facts:
        raise InputError(
            f"{path}: {label} of another {', '.join(facts)}; name another place, or remove it "
            "to start over"
        )


def _entries_apart(stated: str, own: str) -> str:
    """Describe the entries in which two JSON objects differ; "" if they are many, or not JSON."""
    try:
        was, now = (msgspec.json.decode(text, type=dict[str, Any]) for text in (stated, own))
    except msgspec.DecodeError:
        return ""
    differences = "; ".join(
        f"{key} {was.get(key, _ABSENT)}, now {now.get(key, _ABSENT)}"
        for key in {**was, **now}
        if was.get(key) != now.get(key)
    )
    return f" ({differences})" if 0 < len(differences) <= _LINE else ""


def read_identity(path: Path) -> dict[str, str]:
    """Read the identity of a checkpoint's run, or raise InputError."""
    return read_stored(path, "checkpoint", _ANEW, _Checkpoint).identity


def _on_plateau(rate: float, schedule: Plateau, curve: list[CurvePoint]) -> float:
    """Return the rate after these validations, by applying the rule to all from the first one."""
    best, waited = math.inf, 0
    for point in curve:
        best, waited = (point.error, 0) if point.error < best else (best, waited + 1)
        if waited > schedule.patience:
            rate, waited = rate * schedule.factor, 0
    return rate
