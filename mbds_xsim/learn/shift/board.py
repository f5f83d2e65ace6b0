"""Figures of all models on all domains, and what cells of the matrices say of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.learn.shift.domains import Paired
from mbds_xsim.learn.shift.measure import EXPLODED, LOST, Figures
from mbds_xsim.learn.shift.result import INTERVALS, Cell, values
from mbds_xsim.learn.shift.roster import Entry

__all__ = ["ENGINE", "RESTART", "Board", "cells_of", "known_mean", "median", "valid_time"]

Array = NDArray[np.float64]

ENGINE = "engine"
"""Stands for a model where an engine's own motion is the prediction."""
RESTART = "restarted engine"
"""The same where the engine goes on from the last known frame of the domain."""


@dataclass(frozen=True, eq=False)
class Board:
    """Everything that was measured of a scene."""

    test: Paired
    frames: tuple[int, ...]
    """Counted from 1."""
    figures: Mapping[tuple[Entry, str], Figures]
    """By model and domain."""
    oracles: Mapping[tuple[str, str], Figures]
    """By the domain that is taken as the prediction, and the domain it is held against."""
    restarted: Mapping[tuple[str, str], Figures] = field(default_factory=dict)
    """The same, where engines go on from the domain's last known frame."""

    @property
    def at(self) -> NDArray[np.int64]:
        """Places of the frames."""
        return np.array(self.frames) - 1

    @property
    def largest(self) -> float:
        """Squared error that counts for an exploded or lost prediction [m²]."""
        return (EXPLODED * self.test.scene.length) ** 2

    @property
    def entries(self) -> list[Entry]:
        """Trained and trivial models."""
        return list(dict.fromkeys(entry for entry, _ in self.figures))

    @property
    def models(self) -> list[str]:
        """Names of the trained models."""
        return list(dict.fromkeys(e.model for e in self.entries if e.path is not None))

    def runs(self, model: str, training: str) -> list[Entry]:
        """Seeds of a training."""
        return [e for e in self.entries if (e.model, e.training) == (model, training)]

    def errors(self, model: str, training: str, test: str) -> Array:
        """Errors at `frames`, none of them dropped: lost ones count as exploded [m²].

        Returns:
            Shape (seed, trajectory, frame); NaN where the truth is not known.
        """
        found = [self.figures[run, test].error for run in self.runs(model, training)]
        return self.counted(np.stack(found))

    def floor(self, first: str, test: str) -> Array:
        """Distance of an engine from a domain at `frames` [m²], shape (trajectory, frame).

        From the same window where the engine went on from it, else from the same start: that it
        was lost, as on a state that its constraints forbid, is no distance of two engines.
        """
        apart = self.oracles[first, test].error
        if (first, test) not in self.restarted:
            return self.counted(apart)
        found = self.restarted[first, test].error
        return self.counted(np.where(found > self.largest, apart, found))

    def counted(self, error: Array) -> Array:
        """Errors at `frames` with lost ones counted."""
        return np.asarray(np.minimum(error[..., self.at], self.largest))

    def rows(self, interval: str) -> NDArray[np.bool_]:
        """Trajectories of an interval."""
        number = self.test.index % (len(INTERVALS) - 1)
        return np.asarray((interval == INTERVALS[0]) | (number == INTERVALS.index(interval) - 1))


def cells_of(board: Board) -> Iterator[Cell]:
    """Give a cell for every model, domain and interval; engines as models behind the others."""
    for (entry, test), figures in board.figures.items():
        yield from _cells(board, (entry.model, entry.training, entry.seed, test), figures)
    for (first, test), figures in board.oracles.items():
        yield from _cells(board, (ENGINE, first, 0, test), figures)
    for (first, test), figures in board.restarted.items():
        yield from _cells(board, (RESTART, first, 0, test), figures)


def valid_time(error: Array, length: float, frame_s: float) -> tuple[Array, NDArray[np.bool_]]:
    """Time until the root mean square error first exceeds `LOST` of the length.

    Returns:
        [s], shape (trajectory,), the known horizon where it never does; and whether it never does.
    """
    lost = error > (LOST * length) ** 2
    known = (~np.isnan(error)).sum(axis=1)
    never = ~lost.any(axis=1)
    return np.asarray(np.where(never, known, lost.argmax(axis=1)) * frame_s), np.asarray(never)


def median(figures: Array) -> Array:
    """Over the known trajectories, frame by frame; NaN where there is none."""
    found = np.full(figures.shape[1], np.nan)
    known = ~np.isnan(figures).all(axis=0)
    # Where two infinite values meet in the middle their mean is none.
    with np.errstate(invalid="ignore"):
        found[known] = np.nanmedian(figures[:, known], axis=0)
    return found


def known_mean(figures: Array) -> Array:
    """Over the known trajectories, frame by frame; NaN where there is none."""
    known = ~np.isnan(figures)
    total = np.where(known, figures, 0.0).sum(axis=0)
    return np.asarray(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))


def _cells(board: Board, key: tuple[str, str, int, str], figures: Figures) -> Iterator[Cell]:
    for interval in INTERVALS:
        rows = board.rows(interval)
        if rows.any():
            yield _cell(board, key, interval, figures, rows)


def _cell(
    board: Board,
    key: tuple[str, str, int, str],
    interval: str,
    figures: Figures,
    rows: NDArray[np.bool_],
) -> Cell:
    scene, error = board.test.scene, figures.error[rows]
    at = error[:, board.at]
    exploded = np.logical_or.accumulate(error > board.largest, axis=1)[:, board.at]
    time, never = valid_time(error, scene.length, scene.clock.frame)
    begun = ~np.isnan(error[:, 0])
    return Cell(
        *key,
        interval,
        known=_counts(~np.isnan(at)),
        finite=_counts(np.isfinite(at)),
        diverged=_counts(exploded & ~np.isnan(at)),
        mse=values(known_mean(board.counted(error))),
        median=values(median(at)),
        energy=values(median(figures.energy[rows][:, board.at])),
        gap=values(median(figures.gap[rows][:, board.at])),
        one_step=_mean(figures.one_step[rows]),
        valid_s=float(np.median(time[begun])) if begun.any() else None,
        never_lost=int((never & begun).sum()),
        curve=values(median(error)) if interval == INTERVALS[0] else (),
    )


def _counts(flags: NDArray[np.bool_]) -> tuple[int, ...]:
    return tuple(flags.sum(axis=0).tolist())


def _mean(numbers: Array) -> float | None:
    known = numbers[~np.isnan(numbers)]
    return float(known.mean()) if len(known) and np.isfinite(known).all() else None
