"""The contact of each trajectory as a table: the reference, and the engines beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mbds_xsim.report import quantity
from mbds_xsim.report.contact import Contact

__all__ = ["Column", "Table", "tables"]

_Cell = Callable[[Contact, int, Contact], str]
"""Of a motion, a trajectory, and the reference."""


@dataclass(frozen=True)
class Column:
    """A column: what it is called, what it says of a motion."""

    heading: str
    meaning: str
    """One sentence for a tool tip."""
    cell: _Cell


@dataclass(frozen=True)
class Table:
    """One trajectory."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...] | None, ...]
    """Cells of the reference, then of the engine results; None for what has no motion."""


def tables(contacts: tuple[Contact | None, ...], count: int) -> list[Table]:
    """Make the tables of the first trajectories, without columns that say nothing of any.

    Args:
        contacts: Of the reference, then of the engine results; empty without contact.
        count: How many of the trajectories.
    """
    if not contacts:
        return []
    ideal = contacts[0]
    assert ideal is not None
    full = [
        [
            [column.cell(contact, row, ideal) for column in _COLUMNS]
            if contact is not None and np.isfinite(contact.gap[row, 1:]).any()
            else None
            for contact in contacts
        ]
        for row in range(count)
    ]
    told = [
        any(cells is not None and cells[k] != quantity.NONE for rows in full for cells in rows)
        for k in range(len(_COLUMNS))
    ]
    return [
        Table(
            tuple(column for column, keep in zip(_COLUMNS, told, strict=True) if keep),
            tuple(
                None
                if cells is None
                else tuple(cell for cell, keep in zip(cells, told, strict=True) if keep)
                for cells in rows
            ),
        )
        for rows in full
    ]


def _first(contact: Contact, row: int, _: Contact) -> str:
    step = contact.touch[row].any(axis=1)
    return "from the start" if step[0] else _seconds(contact.episodes[row].first)


def _count(contact: Contact, row: int, _: Contact) -> str:
    count = int(contact.impact[row].sum())
    return str(count) if count else quantity.NONE


def _rebound(contact: Contact, row: int, ideal: Contact) -> str:
    height, exact = (c.episodes[row].rebound for c in (contact, ideal))
    if height is None:
        return quantity.NONE
    if contact is ideal or not exact:
        return f"{height:.4f} m"
    return f"{height:.4f} m ({100 * (height / exact - 1):+.2f} %)"


def _restitution(contact: Contact, row: int, _: Contact) -> str:
    episode = contact.episodes[row]
    if not len(episode.arriving):
        return quantity.NONE
    ratio = episode.leaving / episode.arriving
    if np.ptp(ratio) < 1e-3:
        return f"{np.median(ratio):.4f}"
    return f"{np.median(ratio):.4f} ({ratio.min():.3f} to {ratio.max():.3f})"


def _deepest(contact: Contact, row: int, _: Contact) -> str:
    if not np.isfinite(contact.gap[row]).any():
        return quantity.NONE
    return quantity.length(max(0.0, -float(np.nanmin(contact.gap[row]))))


def _rolls(contact: Contact, row: int, _: Contact) -> str:
    return _seconds(contact.episodes[row].rolls)


def _seconds(time: float | None) -> str:
    return quantity.NONE if time is None else f"{time:.3f} s"


_COLUMNS = (
    Column("first touch", "End of the first frame interval in which the ground pushes", _first),
    Column("impacts", "Frame intervals with an impact", _count),
    Column("first rebound", "Height of the ball after its first impact, by its speed", _rebound),
    Column("restitution", "Speed after over before single impacts: median and range", _restitution),
    Column("deepest", "Deepest overlap with the ground in a recorded frame", _deepest),
    Column("rolls from", "When the ball has slid for the last time", _rolls),
)
