"""The contact of each trajectory as a table: the reference, and the engines beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Column, Row, Table
from mbds_xsim.report.palette import Style
from mbds_xsim.studies.validate.episodes import Contact, Episode


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
            (entry, _texts(contact, row, ideal))
            for entry, contact in zip(entries, contacts, strict=True)
            if contact is not None and np.isfinite(contact.gap[row, 1:]).any()
        ]
        for row in range(len(index))
    ]
    every = [texts for rows in told for _, texts in rows]
    kept = [k for k in range(len(_COLUMNS)) if any(texts[k] != quantity.NONE for texts in every)]
    columns = tuple(_COLUMNS[k] for k in kept)
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


_COLUMNS = (
    Column("first touch", "End of the first frame interval in which the ground pushes"),
    Column("impacts", "Frame intervals with an impact"),
    Column("first rebound", "Height of the ball after its first impact, by its speed"),
    Column("restitution", "Speed after over before single impacts: median and range"),
    Column("deepest", "Deepest overlap with the ground in a recorded frame"),
    Column("rolls from", "When the ball has slid for the last time"),
)


def _texts(contact: Contact, row: int, ideal: Contact) -> list[str]:
    """Fill the columns for a trajectory of a motion, beside that of the reference."""
    episode, count = contact.episodes[row], int(contact.impact[row].sum())
    gap = contact.gap[row]
    known = np.isfinite(gap).any()
    return [
        "from the start" if contact.touch[row, 0].any() else _seconds(episode.first),
        str(count) if count else quantity.NONE,
        _rebound(episode.rebound, None if contact is ideal else ideal.episodes[row].rebound),
        _restitution(episode),
        quantity.length(max(0.0, -float(np.nanmin(gap)))) if known else quantity.NONE,
        _seconds(episode.rolls),
    ]


def _rebound(height: float | None, exact: float | None) -> str:
    if height is None:
        return quantity.NONE
    beside = f" ({100 * (height / exact - 1):+.2f} %)" if exact else ""
    return f"{height:.4f} m{beside}"


def _restitution(episode: Episode) -> str:
    if not len(episode.arriving):
        return quantity.NONE
    ratio = episode.leaving / episode.arriving
    spread = f" ({ratio.min():.3f} to {ratio.max():.3f})" if np.ptp(ratio) >= 1e-3 else ""
    return f"{np.median(ratio):.4f}{spread}"


def _seconds(time: float | None) -> str:
    return quantity.NONE if time is None else f"{time:.3f} s"
