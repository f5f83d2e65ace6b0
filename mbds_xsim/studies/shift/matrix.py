"""Trainings by test domains: the figures that tables and heat maps of a shift study show."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
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
    figures: Mapping[tuple[str, str], float | None]

    @property
    def values(self) -> list[list[float | None]]:
        """Rows of figures; None where there is none."""
        return [[self.entry(row, column) for column in self.columns] for row in self.rows]

    @property
    def homes(self) -> list[str]:
        """Trainings on what is a test domain, too."""
        return [row for row in self.rows if row in self.columns]

    def entry(self, training: str, test: str) -> float | None:
        """Give a figure; None where there is none."""
        return self.figures.get((training, test))

    def at_home(self, training: str) -> float | None:
        """Give that of a training on its own domain."""
        return self.entry(training, training)


def trained_models(shift: Shift) -> list[str]:
    """Names of the models that were trained."""
    return list(dict.fromkeys(m.model for m in shift.models if m.engines))


def matrix_of(shift: Shift, model: str, pick: Pick, interval: str = INTERVALS[0]) -> Matrix:
    """Give one figure of all trainings of a model on all domains."""
    cells: dict[tuple[str, str], list[float | None]] = {}
    for cell in shift.cells:
        if (cell.model, cell.interval) == (model, interval):
            cells.setdefault((cell.training, cell.test), []).append(pick(cell))
    rows = tuple(dict.fromkeys(training for training, _ in cells))
    columns = tuple(domain.name for domain in shift.domains)
    return Matrix(model, rows, columns, {key: mean(each) for key, each in cells.items()})


def maps_at(shift: Shift, frame: int) -> list[Matrix]:
    """Errors at a frame of each trained model that there are any of."""
    every = [matrix_of(shift, model, at(shift, frame)) for model in trained_models(shift)]
    return [matrix for matrix in every if any(x is not None for x in matrix.figures.values())]


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
