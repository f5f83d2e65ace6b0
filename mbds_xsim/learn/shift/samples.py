"""A few rollouts to look at: the truth, and models that were trained there and elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbds_xsim.learn.rollout import rollout
from mbds_xsim.learn.shift.board import Board
from mbds_xsim.learn.shift.domains import Domain, Recorded
from mbds_xsim.learn.shift.result import INTERVALS
from mbds_xsim.learn.shift.roster import Entry
from mbds_xsim.learn.window import HISTORY

__all__ = ["Sample", "Samples", "samples_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """Predictions of one model."""

    model: str
    training: str
    at_home: bool
    """Whether it was trained on the domain that is shown."""
    position: Array
    """[m], shape (trajectory, frame, particle, 3); NaN where lost."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Predictions of the same trajectories, from the last known frame on."""

    board: Board
    domain: Recorded
    index: NDArray[np.int64]
    """Numbers of the trajectories, one of each interval."""
    truth: Array
    """[m], shape (trajectory, frame, particle, 3)."""
    models: tuple[Sample, ...]


def samples_of(board: Board) -> Samples:
    """Predict one trajectory of each interval, on the first domain that a model was trained on.

    Of each model the first seed of the training there, and of the training on the engine that is
    furthest from it.
    """
    homes = [e.training for e in board.entries if len(e.engines) == 1]
    domain = next((d for d in board.test.domains if d.name in homes), board.test.domains[0])
    found = [board.rows(interval) for interval in INTERVALS[1:]]
    rows = torch.tensor([int(np.flatnonzero(chosen)[0]) for chosen in found if chosen.any()])
    whole = domain.motions(torch.float64)[rows]
    horizon = min(whole.frame_count - HISTORY, max(board.frames))
    return Samples(
        board=board,
        domain=domain,
        index=whole.index,
        truth=whole.position[:, HISTORY - 1 : HISTORY + horizon].numpy(),
        models=tuple(
            Sample(
                entry.model,
                entry.training,
                entry.training == domain.name,
                _predicted(board, entry, domain, rows, horizon),
            )
            for entry in _chosen(board, domain)
        ),
    )


def _chosen(board: Board, domain: Recorded) -> list[Entry]:
    chosen = []
    for model in board.models:
        singles = [e for e in board.entries if e.model == model and len(e.engines) == 1]
        away = [e for e in singles if e.variant == domain.variant and e.training != domain.name]
        away = [e for e in away if (e.training, domain.name) in board.oracles]
        furthest = sorted(away, key=lambda e: -float(board.floor(e.training, domain.name).mean()))
        chosen += [e for e in singles if e.training == domain.name][:1] + furthest[:1]
    return chosen


def _predicted(board: Board, entry: Entry, domain: Domain, rows: Tensor, horizon: int) -> Array:
    """Start with the last known frame."""
    model = entry.load(board.test.scene)
    motions = domain.motions(model.dtype)[rows]
    rolled = rollout(model, motions, steps=horizon).position
    whole = torch.cat([motions.position[:, HISTORY - 1 : HISTORY], rolled], dim=1)
    return np.asarray(whole.double().numpy())
