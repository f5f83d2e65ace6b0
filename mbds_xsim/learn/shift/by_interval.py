"""What a change of speed costs a model on one engine: a measure of how large a change of engine is.

Source: the shift of covariates beside that of domains, as in Koh et al., WILDS, ICML 2021.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.learn.shift.board import Board
from mbds_xsim.learn.shift.bootstrap import bounds_of
from mbds_xsim.learn.shift.gaps import Draws, Training
from mbds_xsim.learn.shift.result import INTERVALS, Answer, Ratio, values

__all__ = ["SPEED", "answers_by_interval"]

SPEED = "speed"
"""Kind of these answers."""

Array = NDArray[np.float64]
Trained = dict[str, Training]
"""By the interval that a model was trained on."""


def answers_by_interval(board: Board, at: int) -> Iterator[Answer]:
    """Answer for every domain on which models were trained on each interval by itself."""
    if not all(board.rows(interval).any() for interval in INTERVALS[1:]):
        return
    place = board.frames.index(at)
    draws = {interval: Draws(board, interval) for interval in INTERVALS[1:]}
    for domain in board.test.domains:
        fields = {model: _trained(board, model, domain.name) for model in board.models}
        ratios = {
            model: _worst(draws, trained, domain.name)
            for model, trained in fields.items()
            if len(trained) == len(INTERVALS) - 1
        }
        if ratios:
            told = ", ".join(
                f"{model} {r.value[place]:.3g} [{r.low[place]:.3g}, {r.high[place]:.3g}]"
                for model, r in ratios.items()
            )
            text = (
                f"At t = {at} on {domain.name}, trained on the starts of another interval of speed "
                "a model errs by so many times what the one errs that was trained on the interval "
                f"tested, the worst pair of three intervals: {told}"
            )
            yield Answer(
                SPEED,
                f"What does a change of speed cost ({domain.name})?",
                text,
                domain.variant,
                ratios,
            )


def _trained(board: Board, model: str, domain: str) -> Trained:
    entries = [e for e in board.entries if e.model == model and e.interval]
    return {
        e.interval: Training(e.model, e.training, e.engines, e.variant)
        for e in entries
        if domain == f"{e.engines[0]}-{e.variant}"
    }


def _worst(draws: dict[str, Draws], trained: Trained, domain: str) -> Ratio:
    """Largest ratio of errors on an interval, of a training on another to that on itself."""
    value = _largest(trained, lambda own, tested: draws[tested].mean(trained[own], domain))
    drawn = _largest(trained, lambda own, tested: draws[tested].drawn(trained[own], domain))
    low, high = bounds_of(drawn)
    return Ratio(values(value), values(low), values(high))


def _largest(trained: Trained, look: Callable[[str, str], Array]) -> Array:
    pairs = itertools.permutations(trained, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.max([look(a, b) / look(b, b) for a, b in pairs], axis=0))
