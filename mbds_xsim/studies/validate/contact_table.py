"""The contact of each trajectory as a table: the reference, and the engines beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Column, Row, Table
from mbds_xsim.report.palette import Style
from mbds_xsim.studies.validate.episodes import Contact

_Tell = Callable[[Contact, int, Contact], str]
"""Of a motion, a trajectory, and the reference."""


def tables(
    contacts: tuple[Contact | None, ...],
    entries: Sequence[tuple[str, Style]],
    index: Sequence[int],
) -> tuple[Table, ...]:
    """Make a table of each of the first trajectories, without columns that say nothing of any.

    Args:
        contacts: Of the reference, then of the engine results; empty without contact.
        entries: Names and looks of the reference and of the engine results.
        index: Numbers of the trajectories.
    """
    if not contacts:
        return ()
    ideal = contacts[0]
    assert ideal is not None
    told = [
        [
            (entry, [tell(contact, row, ideal) for _, tell in _COLUMNS])
            for entry, contact in zip(entries, contacts, strict=True)
            if contact is not None and np.isfinite(contact.gap[row, 1:]).any()
        ]
        for row in range(len(index))
    ]
    every = [texts for rows in told for _, texts in rows]
    kept = [k for k in range(len(_COLUMNS)) if any(texts[k] != quantity.NONE for texts in every)]
    columns = tuple(_COLUMNS[k][0] for k in kept)
    return tuple(
        Table(
            (Column(f"trajectory {number}", words=True), *columns),
            tuple(
                Row((Cell(name, line=style), *(Cell(texts[k]) for k in kept)))
                for (name, style), texts in rows
            ),
        )
        for number, rows in zip(index, told, strict=True)
    )


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


_COLUMNS: tuple[tuple[Column, _Tell], ...] = (
    (Column("first touch", "End of the first frame interval in which the ground pushes"), _first),
    (Column("impacts", "Frame intervals with an impact"), _count),
    (
        Column("first rebound", "Height of the ball after its first impact, by its speed"),
        _rebound,
    ),
    (
        Column("restitution", "Speed after over before single impacts: median and range"),
        _restitution,
    ),
    (Column("deepest", "Deepest overlap with the ground in a recorded frame"), _deepest),
    (Column("rolls from", "When the ball has slid for the last time"), _rolls),
)
