"""Shift studies as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.report.shift_tables import tables
from mbds_xsim.report.table import Table
from mbds_xsim.safe_text import as_code, in_markdown

__all__ = ["in_words", "protocol", "time_told", "to_markdown"]

_ENOUGH = 3  # seeds


def to_markdown(studies: Sequence[Shift], picture: str = "") -> str:
    """Give the tables and answers of all studies.

    Args:
        studies: One a scene.
        picture: Link to the heat maps.
    """
    lines = [f"![Error by training and test domain]({picture})\n"] if picture else []
    for shift in in_markdown(studies):
        lines += _scene(shift)
    return "\n".join(lines) + "\n"


def _scene(shift: Shift) -> Iterator[str]:
    yield f"# {shift.scene}: learned models under a change of engine\n"
    yield from in_words(shift)
    for table in tables(shift):
        yield f"\n## {table.title}\n"
        yield f"{table.note}.\n"
        yield from _rows(table)
    yield f"\nMade by {as_code(shift.command)} in {time_told(shift)} on {shift.machine}."


def in_words(shift: Shift) -> Iterator[str]:
    """Give the protocol, the answers, and what was left out."""
    yield f"{protocol(shift)}.\n"
    yield from (f"- **{a.question}** {a.answer}." for a in shift.answers)
    yield from (f"- {name} left out: {reason}." for name, reason in shift.left_out.items())


def protocol(shift: Shift) -> str:
    """Say what was done, in a line."""
    seeds = sorted({m.seed for m in shift.models if m.engines})
    profiles = ", ".join(sorted({m.profile for m in shift.models if m.profile})) or "not stated"
    steps = sorted({m.steps for m in shift.models if m.steps})
    ends = sorted({*steps[:1], *steps[-1:]})
    budget = f", {' to '.join(map(str, ends))} steps" if ends else ""
    few = "" if len(seeds) >= _ENOUGH else ", too few to tell of other runs of the same trainings"
    told = sorted({m.model for m in shift.models if m.bodies})
    bodies = f", to {' and '.join(told)} with the bodies' states" if told else ""
    return (
        f"{len(shift.index)} test trajectories that all {len(shift.domains)} domains share, from "
        f"the same starts and inputs; the first {shift.history} frames are the test domain's own"
        f"{bodies}, then {shift.horizon} frames of {shift.frame_s:g} s are predicted. "
        f"Seeds {', '.join(map(str, seeds))}{few}; "
        f"profile {profiles}{budget}; random forces {'act' if shift.noise else 'do not act'} and "
        "are never told to a model"
    )


def time_told(shift: Shift) -> str:
    """Say how long it took, and what had been done before."""
    before = f", {shift.kept} of {len(shift.models)} models tested before" if shift.kept else ""
    return f"{shift.wall_s:.0f} s{before}"


def _rows(table: Table) -> Iterator[str]:
    yield f"| {' | '.join(table.heading)} |"
    yield f"| :-- |{' --: |' * (len(table.heading) - 1)}"
    for row in table.rows:
        yield f"| {' | '.join(row)} |"
