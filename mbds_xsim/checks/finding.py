"""Checks, the figures that they compute, and their findings."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.base.text import apart
from mbds_xsim.checks.record import Record


class Figures(NamedTuple):
    """Figures that a check computes."""

    parts: Array
    """Values of several named parts, shape (trajectory, frame, part)."""
    names: Iterable[str] = ()
    note: str = ""
    uncertainty: Array | float = 0.0
    """Uncertainty of the check, as in `Finding`."""


def side_by_side(parts: Sequence[Array]) -> Array:
    """Join parts, shape (trajectory, frame, part), so that they are apart in memory."""
    rows = [part.T for part in parts]
    joined = np.empty((sum(map(len, rows)), *rows[0].shape[1:]))  # or numpy chooses the order
    return np.concatenate(rows, out=joined).T


@dataclass(frozen=True)
class Check:
    """Check to call with a record."""

    calculate: Callable[[Record], Figures | None]
    name: str
    budget: str | float | Callable[[Record], float] | None
    unit: str
    of_positions: bool

    def __call__(self, record: Record) -> Finding | None:
        """Return the finding on a record; None if there is nothing to check."""
        figures = self.calculate(record)
        if figures is None or not figures.parts.shape[-1]:
            return None
        budget = self.budget
        if isinstance(budget, str):
            budget = float(getattr(record.scene.budget, budget))
        elif callable(budget):
            budget = budget(record)
        return Finding.of(self.name, self.unit, budget=budget, **figures._asdict())

    def finding(self, record: Record) -> Finding:
        """Return the finding on a record to which the check must apply."""
        finding = self(record)
        assert finding is not None, f"{self.name} does not apply to {record.scene.name}"
        return finding


def check(
    name: str,
    budget: str | float | Callable[[Record], float] | None,
    unit: str = "1",
    *,
    of_positions: bool = False,
) -> Callable[[Callable[[Record], Figures | None]], Check]:
    """Turn a function that computes figures into a check, as a decorator.

    Args:
        name: Name in reports.
        budget: Largest allowed figure: a field of the scene's budget, a number, or a function of
            the record; None: shown, not judged.
        unit: Unit of the figure.
        of_positions: Whether positions and orientations suffice; `mbds-xsim audit` runs only such
            checks on files without velocities.
    """
    return lambda calculate: Check(calculate, name, budget, unit, of_positions)


@dataclass(frozen=True, eq=False)
class Finding:
    """Result of one check for all trajectories of a batch."""

    check: str
    unit: str
    series: Array
    """Measured values, 0 is ideal; NaN where there is nothing to measure; (trajectory, frame)."""
    budget: float | None
    """Largest allowed figure; None: shown, not judged."""
    uncertainty: Array
    """Uncertainty of the check itself, added to the budget; shape (trajectory,)."""
    where: tuple[str, ...]
    """Joint, body or component with the worst value, one per trajectory."""
    applies: Mask
    """Whether the check applies, shape (trajectory,); the others have no figure and pass."""
    note: str = ""

    @staticmethod
    def of(
        check: str,
        unit: str,
        parts: Array,
        *,
        budget: float | None,
        names: Iterable[str] = (),
        uncertainty: Array | float = 0.0,
        note: str = "",
    ) -> Finding:
        """Make a finding from values of several named parts, shape (trajectory, frame, part)."""
        names, highest = tuple(names), np.fmax.reduce(parts, axis=1)
        worst = np.where(np.isnan(highest), -np.inf, highest).argmax(axis=1)
        return Finding(
            check,
            unit,
            # Part by part: reductions along a short axis are several times slower.
            functools.reduce(np.fmax, np.moveaxis(parts, -1, 0)),
            budget,
            np.broadcast_to(np.asarray(uncertainty, dtype=np.float64), len(parts)),
            tuple(names[k] if names else "" for k in worst),
            np.ones(len(parts), dtype=bool),
            note,
        )

    def among(self, rows: Mask) -> Finding:
        """Expand a finding on some trajectories of a batch to the whole batch."""
        whole = np.full((len(rows), self.series.shape[1]), np.nan)
        whole[rows] = self.series
        uncertainty, where = np.zeros(len(rows)), np.full(len(rows), "", dtype=object)
        uncertainty[rows], where[rows] = self.uncertainty, self.where
        return replace(
            self, series=whole, uncertainty=uncertainty, where=tuple(where), applies=rows
        )

    @functools.cached_property
    def figure(self) -> Array:
        """Worst value over the frames, NaN if there is none; shape (trajectory,)."""
        return np.take_along_axis(self.series, self.frame[:, None], axis=1)[:, 0]

    @functools.cached_property
    def frame(self) -> Index:
        """Frame of the worst value, shape (trajectory,)."""
        return np.where(np.isnan(self.series), -np.inf, self.series).argmax(axis=1)

    @functools.cached_property
    def passed(self) -> Mask:
        """Whether each trajectory has a figure within the budget, if any, or is not checked."""
        if self.budget is None:
            return np.ones(len(self.figure), dtype=bool)
        return (self.figure <= self.budget + self.uncertainty) | ~self.applies

    def line(self, row: int) -> str:
        """Return one line with the figure of a trajectory and what is allowed."""
        allowed = np.inf if self.budget is None else self.budget
        figure, budget = apart(self.figure[row], allowed, lambda x, n: f"{x:.{n}g}", 3)
        unit = "" if self.unit == "1" else f" {self.unit}"
        where = f" ({self.where[row]})" if self.where[row] else ""
        return f"{self.check}: {figure}{unit}, allowed {budget}{where}"

    @functools.cached_property
    def excess(self) -> Array:
        """Figure less the check's uncertainty, infinite if it is NaN; shape (trajectory,)."""
        excess: NDArray[Any] = self.figure - self.uncertainty
        excess = np.where(np.isnan(excess), np.inf, excess)
        return np.where(self.applies, excess, -np.inf)

    @property
    def worst(self) -> int:
        """Row of the worst trajectory: one without a figure, else that with the largest excess."""
        return int(self.excess.argmax())

    @property
    def share(self) -> float:
        """Largest excess as a share of the budget, which must not be 0; at most 1 if all pass."""
        assert self.budget
        return float(self.excess.max()) / self.budget
