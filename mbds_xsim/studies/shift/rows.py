"""Raw figures of shift studies: a row for every trajectory, so that statistics can be redone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mbds_xsim.base.safe_text import csv_text
from mbds_xsim.learn.particles import RolloutFigures
from mbds_xsim.learn.shift.evaluation import Evaluation
from mbds_xsim.learn.shift.result import INTERVALS
from mbds_xsim.learn.shift.study import ShiftStudy


def to_csv(studies: Sequence[ShiftStudy]) -> bytes:
    """Give the rows of all studies; `inf` is a lost prediction, empty what is not known."""
    frames = list(dict.fromkeys(f for studied in studies for f in studied.shift.frames))
    kinds = ("squared_error_m2", "energy_error", "constraint_gap_m")
    head = ["scene", "model", "training", "seed", "test", "trajectory", "interval", "one_step_m2"]
    head += [f"{kind}_t{frame}" for kind in kinds for frame in frames]
    rows = (row for studied in studies for row in _rows(studied.evaluation, frames))
    return csv_text([head, *rows]).encode()


def _rows(evaluation: Evaluation, frames: Sequence[int]) -> Iterator[list[object]]:
    scene = evaluation.test.scene.name
    for key, figures in evaluation.rolled():
        yield from _figures(evaluation, [scene, *key], figures, frames)


def _figures(
    evaluation: Evaluation, key: list[object], figures: RolloutFigures, frames: Sequence[int]
) -> Iterator[list[object]]:
    series = (figures.error, figures.energy, figures.gap)
    length = figures.error.shape[1]
    for row, number in enumerate(evaluation.test.index.tolist()):
        told = [
            _text(values[row, frame - 1]) if frame <= length else ""
            for values in series
            for frame in frames
        ]
        interval = INTERVALS[1 + number % (len(INTERVALS) - 1)]
        yield [*key, number, interval, _text(figures.one_step[row]), *told]


def _text(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.9g}"
