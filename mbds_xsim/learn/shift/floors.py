"""Floors: what the engines, the noise and chaos alone make of identical starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from mbds_xsim.learn.shift.board import ENGINE, RESTART, Board, known_mean, median
from mbds_xsim.learn.shift.domains import REFERENCE, Domain, Paired
from mbds_xsim.learn.shift.measure import EXPLODED, Figures, measure
from mbds_xsim.learn.shift.result import INTERVALS, Floor, values
from mbds_xsim.learn.shift.truth import Truth
from mbds_xsim.learn.window import HISTORY

__all__ = ["CHAOS_START", "chaos_floor", "floors_of", "noise_floor", "oracles"]

Array = NDArray[np.float64]

CHAOS_START = 1e-4
"""Root mean square displacement of the last known frame that chaos grows from [m]."""


def oracles(domains: Sequence[Domain], horizon: int) -> dict[tuple[str, str], Figures]:
    """Hold every domain against every other, as if it were a prediction.

    They share the start at frame 0, not the window: at the first predicted frame they have had
    `HISTORY` frames to part.
    """
    # Without the bodies' states, which fill more memory than all the rest of so many domains.
    motions = {d.name: dataclasses.replace(d.motions(torch.float64), body=None) for d in domains}
    found = {}
    for first, told in motions.items():
        for test, seen in motions.items():
            if first != test and first != REFERENCE:
                predicted = told.position[:, HISTORY : HISTORY + horizon]
                found[first, test] = measure(seen, predicted)
    return found


def noise_floor(truth: Truth, horizon: int) -> Array:
    """Squared distance of the reference without the noise from that with it [m²].

    Both are at the same state at the last known frame: what a perfect model, which does not see
    the noise, gets wrong. Shape (trajectory, frame).
    """
    seen = truth.position[:, HISTORY : HISTORY + horizon]
    return np.asarray(((truth.quiet[:, :horizon] - seen) ** 2).sum(-1).mean(-1))


def chaos_floor(test: Paired, truth: Truth, horizon: int) -> Array:
    """Squared distance that a displacement by `CHAOS_START` at the last known frame grows to [m²].

    By the reference's growth factor, which is of small errors: it ends at what counts as exploded.
    Shape (trajectory, frame).
    """
    last = HISTORY - 1
    growth = truth.growth[:, last + 1 : last + 1 + horizon] / truth.growth[:, last, None]
    return np.minimum((CHAOS_START * growth) ** 2, (EXPLODED * test.scene.length) ** 2)


def floors_of(board: Board, noise: Array | None, chaos: Array | None) -> Iterator[Floor]:
    """Give all floors of all intervals."""
    for (first, test), figures in board.oracles.items():
        yield from _floors(board, (ENGINE, first, test), figures.error)
    for (first, test), figures in board.restarted.items():
        yield from _floors(board, (RESTART, first, test), figures.error)
    for kind, error in (("noise", noise), ("chaos", chaos)):
        if error is not None:
            yield from _floors(board, (kind, REFERENCE, REFERENCE), error)


def _floors(board: Board, key: tuple[str, str, str], error: Array) -> Iterator[Floor]:
    for interval in INTERVALS:
        rows = board.rows(interval)
        if not rows.any():
            continue
        counted = board.counted(error)[rows]
        yield Floor(
            *key,
            interval,
            mse=values(known_mean(counted)),
            median=values(median(error[rows][:, board.at])),
            curve=values(median(error)) if interval == INTERVALS[0] else (),
        )
