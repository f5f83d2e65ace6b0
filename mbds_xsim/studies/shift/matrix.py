"""Trainings by test domains: the figures that tables and heat maps of a shift study show."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mbds_xsim.learn.shift.models import TRIVIAL
from mbds_xsim.learn.shift.result import INTERVALS, ErrorCell, Shift

Pick = Callable[[ErrorCell], float | None]


@dataclass(frozen=True)
class Matrix:
    """Trainings of a model by test domains: means over seeds."""

    model: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    values: tuple[tuple[float | None, ...], ...]

    @property
    def has_figures(self) -> bool:
        """Whether there is anything to draw."""
        return any(value is not None for row in self.values for value in row)

    @property
    def homes(self) -> list[str]:
        """Trainings on what is a test domain, too."""
        return [row for row in self.rows if row in self.columns]

    def entry(self, training: str, test: str) -> float | None:
        """Give a figure; None where there is none."""
        if training not in self.rows:
            return None
        return self.values[self.rows.index(training)][self.columns.index(test)]

    def at_home(self, training: str) -> float | None:
        """Give that of a training on its own domain."""
        return self.entry(training, training)


def trained_models(shift: Shift) -> list[str]:
    """Names of the models that were trained."""
    return list(dict.fromkeys(m.model for m in shift.models if m.engines))


def matrix_of(shift: Shift, model: str, pick: Pick, interval: str = INTERVALS[0]) -> Matrix:
    """Give one figure of all trainings of a model on all domains."""
    cells = [c for c in shift.cells if c.model == model and c.interval == interval]
    rows = tuple(dict.fromkeys(cell.training for cell in cells))
    columns = tuple(domain.name for domain in shift.domains)
    found: dict[tuple[str, str], list[float | None]] = {}
    for cell in cells:
        found.setdefault((cell.training, cell.test), []).append(pick(cell))
    values = tuple(tuple(mean(found.get((row, c), [])) for c in columns) for row in rows)
    return Matrix(model, rows, columns, values)


def best_formula(shift: Shift, pick: Pick, interval: str = INTERVALS[0]) -> dict[str, float]:
    """Give the least figure of the models that learn nothing, by domain, where all have one."""
    matrices = [matrix_of(shift, name, pick, interval) for name in TRIVIAL]
    found: dict[str, float] = {}
    for domain in matrices[0].columns:
        # Where no trajectory is of the interval there is no row.
        row = [matrix.entry(name, domain) for matrix in matrices for name in matrix.rows[:1]]
        known = [figure for figure in row if figure is not None]
        if len(known) == len(TRIVIAL):
            found[domain] = min(known)
    return found


def at(shift: Shift, frame: int) -> Pick:
    """Pick the mean squared error at a frame."""
    place = shift.frames.index(frame)
    return lambda cell: cell.mse[place]


def mean(figures: Sequence[float | None]) -> float | None:
    """Average; None where one of them is: a run that was lost is not dropped."""
    known = [x for x in figures if x is not None]
    return statistics.fmean(known) if known and len(known) == len(figures) else None
