"""Contact under the viewer: strips over time, and what each motion did in each trajectory.

The strips show heights, slips, and which spheres touch and when; the tables show the reference and
the engines beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mbds_xsim.measure.result import Evidence, Validation
from mbds_xsim.report import quantity
from mbds_xsim.report.animation import encoded, in_base64
from mbds_xsim.report.blocks import Cell, Column, Row, Table
from mbds_xsim.report.palette import Style
from mbds_xsim.studies.validate.episodes import Contact, Episode


def pack(
    validation: Validation, evidence: Evidence, contacts: tuple[Contact | None, ...], count: int
) -> dict[str, Any]:
    """Give what the script of the strips reads, ready for JSON.

    Args:
        validation: With the ends of what is known.
        evidence: Motions of the engines and the reference.
        contacts: Of the reference, then of the engine results; those that crashed are left out.
        count: How many of the trajectories the viewer has.
    """
    reference = validation.reference
    known = () if reference is None else reference.known_s
    found = [contact for contact in contacts if contact is not None]
    return {
        "step": evidence.scene.clock.frame,
        "frames": len(evidence.reference.time),
        "spheres": len(evidence.scene.contacts),
        "ends": list(known[:count]) or [None] * count,
        "slips": any(np.nan_to_num(contact.slip).any() for contact in found),
        "entries": [_entry(contact, count) for contact in found],
    }


def reading(evidence: Evidence, *, slips: bool) -> str:
    """Say how to read the strips."""
    lanes = _lanes([sphere.body for sphere in evidence.scene.contacts])
    slip = (
        " Slip: mean speed of the points that touch along the ground, 0 where they roll or stick."
        if slips
        else ""
    )
    several = (
        " Where several may touch at once, frames cannot tell which one the ground pushed: all are "
        "marked."
        if lanes
        else ""
    )
    return (
        "Height: from the ground to the lowest contact sphere, below 0 where it overlaps."
        f"{slip} Touch{f' ({lanes})' if lanes else ''}: pale where the ground carries, solid below "
        "a triangle where it hits. In the motion, a dot marks where a sphere touches, a halo where "
        f"it hits.{several}"
    )


def _lanes(names: list[str]) -> str:
    """Say which contact sphere each lane of the strips is, where there are several."""
    if len(names) == 1:
        return ""
    if len(set(names)) == 1:
        return f"{len(names)} lanes, one for each sphere of {names[0]}"
    return f"lanes from above: {', '.join(names)}"


def _entry(contact: Contact, count: int) -> dict[str, str]:
    """Bits of a step are the spheres that touch, then whether it has an impact."""
    flags = np.concatenate([contact.touch, contact.impact[..., None]], axis=2)[:count]
    return {
        "gap": encoded(contact.gap[:count], "<f4"),
        "slip": encoded(contact.slip[:count], "<f4"),
        "flags": in_base64(np.packbits(flags, axis=2)),
    }


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
