"""Predict whole trajectories, many at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mbds_xsim.errors import InputError
from mbds_xsim.learn.model import Model
from mbds_xsim.learn.window import HISTORY, Inputs, Motions, Start

__all__ = ["Rollout", "go_on", "roll", "rollout"]

_BATCH = 512
_NODES = 4096
"""At a time on a CPU: the tensors of more leave its caches, and are so large that each is made of
pages new from the system, which makes rows dearer."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """Predicted positions beside the true ones; frame 0 is the first predicted."""

    position: Tensor
    """[m], shape (trajectory, frame, particle, 3); not a number from where a prediction failed."""
    truth: Tensor
    """[m], of the same shape."""

    @property
    def failed(self) -> Tensor:
        """Whether a trajectory became not finite, bool, shape (trajectory,)."""
        return ~self.position[:, -1].isfinite().all(-1).all(-1)

    @property
    def squared_error(self) -> Tensor:
        """Mean over particles of the squared distance [m²], shape (trajectory, frame).

        Not a number where the prediction failed: to be counted, never dropped.
        """
        return ((self.position - self.truth) ** 2).sum(-1).mean(-1)


def rollout(
    model: Model, motions: Motions, *, steps: int | None = None, batch: int = _BATCH
) -> Rollout:
    """Predict trajectories from their first `HISTORY` frames on.

    Args:
        model: On the device of the motions.
        motions: What really happened, and its inputs.
        steps: Frames to predict; left out, all.
        batch: Trajectories at a time.

    Raises:
        InputError: There are not so many frames, or the model needs the bodies' states.
    """
    most = motions.frame_count - HISTORY
    steps = most if steps is None else steps
    if not 1 <= steps <= most:
        msg = f"steps: got {steps}, allowed is 1 to {most}"
        raise InputError(msg)
    if model.needs_bodies and motions.body is None:
        msg = "this model starts from the bodies' states; read the motions with bodies=True"
        raise InputError(msg)
    parts = []
    with torch.no_grad():
        for k in range(0, len(motions), batch):
            rows = torch.arange(k, min(k + batch, len(motions)), device=motions.position.device)
            sample = motions.sample(rows, torch.full_like(rows, HISTORY - 1), steps)
            parts.append(roll(model, sample.start, sample.inputs))
    return Rollout(torch.cat(parts), motions.position[:, HISTORY : HISTORY + steps])


def roll(model: Model, start: Start, inputs: Inputs) -> Tensor:
    """Predict frame by frame.

    Args:
        model: Which model.
        start: What is known.
        inputs: Over all frames to come, shapes (batch, frame, body, 3) and (batch, frame, hinge).

    Returns:
        Positions [m], shape (batch, frame, particle, 3). A row that is not finite at a frame stays
        so, and the others go on undisturbed.
    """
    block = len(start)
    if start.history.device.type == "cpu":
        block = max(1, _NODES // model.graph.node_count)
    parts = range(0, len(start), block)
    return torch.cat(
        [go_on(model, model.begin(start[k : k + block]), inputs[k : k + block]) for k in parts]
    )


def go_on(model: Model, state: Tensor, inputs: Inputs) -> Tensor:
    """Do as `roll` does from states of the model's own, all rows at once."""
    first = state
    alive = torch.ones(len(state), dtype=torch.bool, device=state.device)
    frames = []
    for frame in range(inputs.torque.shape[1]):
        state = model.advance(state, inputs.at(frame))
        alive = alive & state.flatten(1).isfinite().all(1)
        # Solvers refuse numbers that are none: failed rows are kept at their start, unseen.
        state = torch.where(_like(alive, state), state, first)
        seen = model.positions(state)
        frames.append(torch.where(_like(alive, seen), seen, torch.nan))
    return torch.stack(frames, dim=1)


def _like(flags: Tensor, values: Tensor) -> Tensor:
    return flags.reshape(-1, *[1] * (values.dim() - 1))
