"""Changes between two stored results: verdicts, reasons, settings, figures, times."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import in_utf8
from mbds_xsim.studies.diff import FAILING, Entry, PhysicalFigure, Value, View
from mbds_xsim.studies.diff.read import read_views

SCHEMA = "mbds-xsim/diff/1"
RTOL = 1e-6
"""Largest relative difference at which figures of physics count as the same."""
FACTOR = 1.5
"""Largest factor between two times at which they count as the same."""

_ROUNDING = 1e-14  # figures that differ by less are the same, whatever their unit
# Figures other than times that the machine decides.
_NO_TIME = re.compile(r"core|rate|bytes|_mb\b|_per_s\b")
_NUMBER = re.compile(r"\d[\d.]*(e[+-]?\d+)?( ?[mµn]?[ms]\b)?")


class Change(msgspec.Struct, frozen=True):
    """A setting or another value that has changed; None where it is missing."""

    what: str
    old: Value
    new: Value


class FigureChange(msgspec.Struct, frozen=True):
    """A figure that has changed."""

    what: str
    unit: str
    old: float | None
    new: float | None
    ratio: float | None
    """New over old; None where one is missing or the old one is 0."""


class EntryDiff(msgspec.Struct, frozen=True, kw_only=True):
    """Changes of one engine, curve, point or cell."""

    name: str
    old_verdict: str
    new_verdict: str
    worse: tuple[str, ...]
    """One line for each verdict or budget that is worse now."""
    better: tuple[str, ...]
    settings: tuple[Change, ...]
    reasons_new: tuple[str, ...]
    reasons_gone: tuple[str, ...]
    """Reasons that are gone; those that differ in numbers only are neither new nor gone."""
    figures: tuple[FigureChange, ...]
    """Figures of physics."""
    timings: tuple[FigureChange, ...]

    @property
    def changed(self) -> bool:
        """Whether anything but times changed."""
        verdict = self.old_verdict != self.new_verdict
        reasons = self.reasons_new or self.reasons_gone
        return bool(verdict or self.worse or self.settings or reasons or self.figures)


class OnlyIn(msgspec.Struct, frozen=True):
    """An entry that one of the files lacks."""

    name: str
    verdict: str
    why: str
    """Reason why the other file left it out; empty if it was not asked for."""


class Diff(msgspec.Struct, frozen=True, kw_only=True):
    """Changes of one scene."""

    scene: str
    old_command: str
    new_command: str
    sample: tuple[Change, ...]
    """Changes of starts, seed or budgets, which alone may explain why figures differ."""
    circumstances: tuple[Change, ...]
    """Changes of versions and machine."""
    entries: tuple[EntryDiff, ...]
    """Entries in which anything changed, times included."""
    unchanged: int
    only_old: tuple[OnlyIn, ...]
    only_new: tuple[OnlyIn, ...]
    worse: tuple[str, ...]
    """One line for each verdict or budget that is worse, and each good entry now left out."""
    better: tuple[str, ...]


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Comparison of two files."""

    schema: str
    compared: str
    """Schema of both files."""
    old: str
    new: str
    rtol: float
    factor: float
    verdict: Literal["worse", "changed", "same"]
    """Verdict that ignores times: `same` if nothing else changed."""
    scenes: tuple[Diff, ...]
    scenes_only_old: tuple[str, ...]
    scenes_only_new: tuple[str, ...]


def compare_files(
    old: Path, new: Path, *, rtol: float = RTOL, factor: float = FACTOR
) -> Comparison:
    """Compare two files that the same command wrote with `--json`.

    Args:
        old: The earlier one.
        new: The later one.
        rtol: Largest difference at which figures of physics count as the same, relative to the
            figures or to their budget.
        factor: Largest factor between two times at which they count as the same.

    Raises:
        InputError: A file cannot be used, or the two are not of the same command and scene.
    """
    schema, before = read_views(old)
    other_schema, after = read_views(new)
    if schema != other_schema:
        raise InputError(f"{old} is {schema} and {new} is {other_schema}; give two of the same")
    both = [name for name in after if name in before]
    if not both:
        old_names, new_names = ", ".join(before), ", ".join(after)
        raise InputError(f"{old} is about {old_names} and {new} about {new_names}; give two of one")
    scenes = tuple(_diff(before[name], after[name], rtol, factor) for name in both)
    only_old = tuple(name for name in before if name not in both)
    only_new = tuple(name for name in after if name not in both)
    return Comparison(
        schema=SCHEMA,
        compared=schema,
        old=in_utf8(str(old)),
        new=in_utf8(str(new)),
        rtol=rtol,
        factor=factor,
        verdict=_verdict(scenes, bool(only_old or only_new)),
        scenes=scenes,
        scenes_only_old=only_old,
        scenes_only_new=only_new,
    )


def _verdict(scenes: tuple[Diff, ...], alone: bool) -> Literal["worse", "changed", "same"]:
    if any(diff.worse for diff in scenes):
        return "worse"
    changed = any(
        diff.only_old or diff.only_new or any(entry.changed for entry in diff.entries)
        for diff in scenes
    )
    return "changed" if changed or alone else "same"


def _diff(old: View, new: View, rtol: float, factor: float) -> Diff:
    for change in _changes(old.identity, new.identity):
        if change.old is not None and change.new is not None:
            raise InputError(
                f"{new.scene} is not the same scene in both files: {change.what} is {change.old} "
                f"and {change.new}; give two results of one scene"
            )
    pairs = [
        _entry_diff(name, old.entries[name], entry, rtol, factor)
        for name, entry in new.entries.items()
        if name in old.entries
    ]
    shown = tuple(pair for pair in pairs if pair.changed or pair.timings)
    only_old = tuple(_only_in(old, new))
    ranks = ((one, old.entries[one.name].rank) for one in only_old if one.why)
    lost = [one for one, rank in ranks if rank is not None and rank < FAILING]
    return Diff(
        scene=new.scene,
        old_command=old.command,
        new_command=new.command,
        sample=tuple(_changes(old.sample, new.sample)),
        circumstances=tuple(_changes(old.circumstances, new.circumstances)),
        entries=shown,
        unchanged=len(pairs) - len(shown),
        only_old=only_old,
        only_new=tuple(_only_in(new, old)),
        worse=(
            *(f"{pair.name}: {line}" for pair in pairs for line in pair.worse),
            *(f"{one.name}: was {one.verdict}, is left out now: {one.why}" for one in lost),
        ),
        better=tuple(f"{pair.name}: {line}" for pair in pairs for line in pair.better),
    )


def _only_in(view: View, other: View) -> Iterator[OnlyIn]:
    """List the entries that the other view lacks, without the parts of those listed."""
    for name, entry in view.entries.items():
        if name in other.entries or (entry.parent and entry.parent not in other.entries):
            continue
        reasons = (
            reason
            for omitted, reason in other.left_out.items()
            if omitted not in view.left_out and f"{name} ".startswith(f"{omitted} ")
        )
        yield OnlyIn(name, entry.verdict, next(reasons, ""))


def _entry_diff(name: str, old: Entry, new: Entry, rtol: float, factor: float) -> EntryDiff:
    """Return the changes of an entry; the thresholds are those of `compare_files`."""
    return EntryDiff(
        name=name,
        old_verdict=old.verdict,
        new_verdict=new.verdict,
        worse=tuple(_losses(old, new)),
        better=tuple(_losses(new, old, "{new} → {old}", "{check} keeps its budget now")),
        settings=tuple(_changes(old.settings, new.settings)),
        reasons_new=_without(new.reasons, old.reasons),
        reasons_gone=_without(old.reasons, new.reasons),
        figures=tuple(_figure_changes(old.figures, new.figures, rtol)),
        timings=tuple(_timing_changes(old.timings, new.timings, factor)),
    )


def _losses(
    old: Entry,
    new: Entry,
    verdict: str = "{old} → {new}",
    budget: str = "{check} no longer keeps its budget",
) -> Iterator[str]:
    """Yield a line for each verdict or budget that is worse in the new entry."""
    if old.rank is not None and new.rank is not None and new.rank > old.rank:
        yield verdict.format(old=old.verdict, new=new.verdict)
    for check in sorted(new.broken):
        if old.keeps(check):
            yield budget.format(check=check)


def _changes(old: Mapping[str, Value], new: Mapping[str, Value]) -> Iterator[Change]:
    for name in dict.fromkeys((*old, *new)):
        if old.get(name) != new.get(name):
            yield Change(name, old.get(name), new.get(name))


def _without(reasons: tuple[str, ...], others: tuple[str, ...]) -> tuple[str, ...]:
    """Keep the reasons that the others lack, whatever their numbers and places."""
    known = {_kind(reason) for reason in others}
    return tuple(reason for reason in reasons if _kind(reason) not in known)


def _kind(reason: str) -> str:
    return _NUMBER.sub("#", reason.split(", allowed ")[0])


def _figure_changes(
    old: Mapping[str, PhysicalFigure], new: Mapping[str, PhysicalFigure], rtol: float
) -> Iterator[FigureChange]:
    for name in dict.fromkeys((*old, *new)):
        one, other = old.get(name, PhysicalFigure(None)), new.get(name, PhysicalFigure(None))
        if not _same(one.value, other.value, rtol, max(one.scale, other.scale)):
            unit = other.unit if name in new else one.unit
            yield FigureChange(name, unit, one.value, other.value, _ratio(one.value, other.value))


def _timing_changes(
    old: Mapping[str, float | None], new: Mapping[str, float | None], factor: float
) -> Iterator[FigureChange]:
    for name in dict.fromkeys((*old, *new)):
        ratio = _ratio(old.get(name), new.get(name))
        if ratio is not None and not 1.0 / factor <= ratio <= factor:
            unit = "1" if _NO_TIME.search(name) else "s"
            yield FigureChange(name, unit, old.get(name), new.get(name), ratio)


def _same(one: float | None, other: float | None, rtol: float, scale: float) -> bool:
    if one is None or other is None:
        return one is other
    return math.isclose(one, other, rel_tol=rtol, abs_tol=max(rtol * scale, _ROUNDING))


def _ratio(old: float | None, new: float | None) -> float | None:
    return None if old is None or new is None or old == 0.0 else new / old
