"""What a change of engine costs: models on a domain against those that were trained there."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.learn.shift.board import Board
from mbds_xsim.learn.shift.bootstrap import Resampler, bounds_of
from mbds_xsim.learn.shift.result import INTERVALS, Gap, Values, values
from mbds_xsim.learn.shift.roster import Entry

__all__ = ["Draws", "Training", "gaps_of", "kind_of", "trainings_of", "why_unresolved"]

Array = NDArray[np.float64]

SINGLE, LEAVE_ONE_OUT, ALL = "single", "leave-one-out", "all"

WEAK = "own error exceeds the engine floor"
UNSURE = "interval contains 0"
UNKNOWN = "own domain is not tested, so neither own error nor engine floor is known"
"""Why gaps tell nothing of a shift."""


@dataclass(frozen=True)
class Training:
    """Models of one kind and training; they differ in their seeds."""

    model: str
    name: str
    engines: tuple[str, ...]
    variant: str

    @property
    def domains(self) -> tuple[str, ...]:
        """That it was trained on."""
        return tuple(f"{engine}-{self.variant}" for engine in self.engines)


class Draws:
    """Mean errors of trainings on domains, and resampled ones, all drawn together."""

    def __init__(self, board: Board, interval: str = INTERVALS[0]) -> None:
        self.board, self._rows = board, board.rows(interval)
        self._resampler = Resampler(int(self._rows.sum()))
        self.mean = functools.cache(self._mean)
        self.drawn = functools.cache(self._drawn)

    def _mean(self, training: Training, test: str) -> Array:
        return np.asarray(self._errors(training, test).mean(axis=(0, 1)))

    def _drawn(self, training: Training, test: str) -> Array:
        errors = self._errors(training, test)
        seeds = [run.seed for run in self.board.runs(training.model, training.name)]
        return self._resampler.means(errors, f"{training.model} {seeds}")

    def _errors(self, training: Training, test: str) -> Array:
        return self.board.errors(training.model, training.name, test)[:, self._rows]


def trainings_of(board: Board, model: str) -> list[Training]:
    """Trainings of a model on all starts, in order.

    To leave one of two engines out is to train on the other.
    """
    found: dict[tuple[str, ...], Training] = {}
    entries = [entry for entry in board.entries if entry.model == model and not entry.interval]
    for training in map(_training, entries):
        if training.domains not in found or training.name in training.domains:
            found[training.domains] = training
    return list(found.values())


def kind_of(training: Training, test: str, every: Sequence[str]) -> str:
    """Give what a training is to a test domain; "" where there is no shift between them.

    Of several engines' trainings only engines that were left out are told, in either variant: what
    other settings of a known engine do, single ones tell.

    Args:
        training: What was trained.
        test: Where it is tested.
        every: All engine domains.
    """
    if len(training.engines) == 1:
        return "" if test in training.domains else SINGLE
    if set(domain for domain in every if domain.endswith(f"-{training.variant}")) <= set(
        training.domains
    ):
        return ALL
    return "" if test.rpartition("-")[0] in training.engines else LEAVE_ONE_OUT


def gaps_of(board: Board, draws: Draws, noise: Array, chaos: Array) -> Iterator[Gap]:
    """Give all gaps to models that were trained on the target.

    Args:
        board: What was measured.
        draws: Of the same board.
        noise: Mean noise floor at the frames [m²], NaN where not known.
        chaos: Mean chaos floor.
    """
    every = [domain.name for domain in board.test.domains]
    for model in board.models:
        trainings = trainings_of(board, model)
        targets = {t.domains[0]: t for t in trainings if len(t.engines) == 1}
        for training in trainings:
            for test in every:
                kind = kind_of(training, test, every)
                if kind and test in targets:
                    yield _gap(draws, kind, training, targets[test], (noise, chaos))


def why_unresolved(own: float, floor: float, low: float, high: float) -> str:
    """Say why a gap tells nothing of a shift; "" where it does.

    Args:
        own: Error of the training on its own domain [m²]; NaN where that is not tested.
        floor: Distance of its engine from the target's [m²], alike.
        low: Of the interval of the difference [m²].
        high: The same.
    """
    if np.isnan(own) or np.isnan(floor):
        return UNKNOWN
    if own > floor:
        return WEAK
    return "" if low > 0.0 or high < 0.0 else UNSURE


def _training(entry: Entry) -> Training:
    return Training(entry.model, entry.training, entry.engines, entry.variant)


def _gap(
    draws: Draws, kind: str, training: Training, target: Training, floors: tuple[Array, Array]
) -> Gap:
    test, board = target.domains[0], draws.board
    here, there = draws.mean(training, test), draws.mean(target, test)
    drawn = draws.drawn(training, test), draws.drawn(target, test)
    own, floor = _own_and_floor(draws, training, test)
    low, high = bounds_of(drawn[0] - drawn[1])
    why = [why_unresolved(*each) for each in zip(own, floor, low, high, strict=True)]
    ratio_low, ratio_high = _finite_bounds(_ratio(*drawn))
    return Gap(
        model=training.model,
        kind=kind,
        training=training.name,
        test=test,
        seeds=(
            len(board.runs(training.model, training.name)),
            len(board.runs(target.model, target.name)),
        ),
        own=values(own),
        transferred=values(here),
        target=values(there),
        ratio=values(_ratio(here, there)),
        ratio_low=ratio_low,
        ratio_high=ratio_high,
        difference=values(here - there),
        difference_low=values(low),
        difference_high=values(high),
        engine_floor=values(floor),
        noise_floor=values(floors[0]),
        chaos_floor=values(floors[1]),
        resolved=tuple(not reason for reason in why),
        why=tuple(why),
    )


def _own_and_floor(draws: Draws, training: Training, test: str) -> tuple[Array, Array]:
    """R_ii and D_ij of the engine i of the training from which √R_ij ≤ √R_ii + √D_ij says most.

    Both are NaN where no other domain of the training is tested.
    """
    board = draws.board
    tested = {domain.name for domain in board.test.domains}
    others = [n for n in training.domains if n in tested and (n, test) in board.oracles]
    if not others:
        return (np.full(len(board.frames), np.nan),) * 2
    own = np.stack([draws.mean(training, name) for name in others])
    floor = np.stack([board.floor(name, test).mean(axis=0) for name in others])
    most = np.sqrt(own) + np.sqrt(floor)
    least = np.where(np.isnan(most), np.inf, most).argmin(axis=0)[None]
    return np.take_along_axis(own, least, 0)[0], np.take_along_axis(floor, least, 0)[0]


def _ratio(here: Array, there: Array) -> Array:
    """Not a number where both are 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(here / there)


def _finite_bounds(ratios: Array) -> tuple[Values, Values]:
    with np.errstate(invalid="ignore"):
        low, high = bounds_of(ratios)
    return values(low), values(high)
