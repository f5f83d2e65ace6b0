"""What a check finds."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.base.text import apart
from mbds_xsim.checks.record import Record


class Figures(NamedTuple):
    """What a check calculates."""

    parts: Array
    """Values of several parts, named alike, shape (trajectory, frame, part)."""
    names: Iterable[str] = ()
    note: str = ""
    uncertainty: Array | float = 0.0
    """As in `Finding`."""


@dataclass(frozen=True)
class Check:
    """A check, which is called with a record."""

    calculate: Callable[[Record], Figures | None]
    name: str
    budget: str | float | Callable[[Record], float] | None
    unit: str

    def __call__(self, record: Record) -> Finding | None:
        """Give the finding on a record; None where there is no part to look at."""
        found = self.calculate(record)
        if found is None or not found.parts.shape[-1]:
            return None
        budget = self.budget
        if isinstance(budget, str):
            budget = float(getattr(record.scene.budget, budget))
        return Finding.of(
            self.name,
            self.unit,
            found.parts,
            budget=budget(record) if callable(budget) else budget,
            names=tuple(found.names),
            uncertainty=found.uncertainty,
            note=found.note,
        )

    def finding(self, record: Record) -> Finding:
        """Give the finding on a record that has something for the check to look at."""
        found = self(record)
        assert found is not None, f"{self.name} does not apply to {record.scene.name}"
        return found


def check(
    name: str, budget: str | float | Callable[[Record], float] | None, unit: str = "1"
) -> Callable[[Callable[[Record], Figures | None]], Check]:
    """Make a check of what calculates its figures.

    Args:
        name: As reports call it.
        budget: What the figure may reach: a field of the scene's budget, a number, or what gives
            it for a record; None: shown, not judged.
        unit: Of the figure.
    """
    return lambda calculate: Check(calculate, name, budget, unit)


@dataclass(frozen=True, eq=False)
class Finding:
    """One check on all trajectories of a batch."""

    check: str
    unit: str
    series: Array
    """What the check measures, 0 is ideal; NaN where there is nothing to see; shape (trajectory,
    frame)."""
    budget: float | None
    """What the figure may reach; None: shown, not judged."""
    uncertainty: Array
    """What the check itself cannot resolve, added to the budget; shape (trajectory,)."""
    where: tuple[str, ...]
    """Which joint, body or component the worst value belongs to, one a trajectory."""
    applies: Mask
    """Trajectories that the check is about, shape (trajectory,); others have no figure and pass."""
    note: str = ""

    @staticmethod
    def of(
        check: str,
        unit: str,
        parts: Array,
        *,
        budget: float | None,
        names: tuple[str, ...] = (),
        uncertainty: Array | float = 0.0,
        note: str = "",
    ) -> Finding:
        """Make a finding from values of several parts, named alike, (trajectory, frame, part)."""
        highest = np.fmax.reduce(parts, axis=1)
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
        """Give a finding on some trajectories of a batch as one on the batch."""
        whole = np.full((len(rows), self.series.shape[1]), np.nan)
        whole[rows] = self.series
        uncertainty, where = np.zeros(len(rows)), np.full(len(rows), "", dtype=object)
        uncertainty[rows], where[rows] = self.uncertainty, self.where
        return replace(
            self, series=whole, uncertainty=uncertainty, where=tuple(where), applies=rows
        )

    @functools.cached_property
    def figure(self) -> Array:
        """Worst over the frames, NaN where there is none; shape (trajectory,)."""
        return np.take_along_axis(self.series, self.frame[:, None], axis=1)[:, 0]

    @functools.cached_property
    def frame(self) -> Index:
        """Frame of the worst value, shape (trajectory,)."""
        return np.where(np.isnan(self.series), -np.inf, self.series).argmax(axis=1)

    @functools.cached_property
    def passed(self) -> Mask:
        """Whether the figure keeps its budget; a trajectory without a figure does not."""
        if self.budget is None:
            return np.ones(len(self.figure), dtype=bool)
        return (self.figure <= self.budget + self.uncertainty) | ~self.applies

    def line(self, row: int) -> str:
        """Say in a line what a trajectory has of what is allowed."""
        allowed = np.inf if self.budget is None else self.budget
        figure, budget = apart(self.figure[row], allowed, lambda x, n: f"{x:.{n}g}", 3)
        unit = "" if self.unit == "1" else f" {self.unit}"
        where = f" ({self.where[row]})" if self.where[row] else ""
        return f"{self.check}: {figure}{unit}, allowed {budget}{where}"

    @property
    def worst(self) -> int:
        """Row of the trajectory that comes off worst: no figure at all, else the largest."""
        excess: NDArray[Any] = self.figure - self.uncertainty
        excess = np.where(np.isnan(excess), np.inf, excess)
        return int(np.where(self.applies, excess, -np.inf).argmax())
