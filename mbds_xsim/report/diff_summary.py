"""A comparison in words and rows, for terminal and Markdown alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mbds_xsim.report import quantity
from mbds_xsim.study.diff import Change, Comparison, Diff, EntryDiff, FigureChange
from mbds_xsim.study.view import Value

__all__ = ["HEADINGS", "Line", "conclusion", "figure_lines", "remarks", "thresholds", "time_lines"]

HEADINGS = ("entry", "what", "before", "now", "change")


@dataclass(frozen=True)
class Line:
    """A row of the table: what was and what is."""

    entry: str
    what: str
    before: str
    now: str
    change: str = ""
    worse: bool = False

    @property
    def cells(self) -> tuple[str, ...]:
        """In the order of `HEADINGS`."""
        return (self.entry, self.what, self.before, self.now, self.change)


def figure_lines(diff: Diff) -> list[Line]:
    """Everything that changed but times."""
    return [line for entry in diff.entries for line in _entry_lines(entry)]


def time_lines(diff: Diff) -> list[Line]:
    """Times that changed."""
    return [_figure(entry.name, what) for entry in diff.entries for what in entry.timings]


def _entry_lines(entry: EntryDiff) -> Iterator[Line]:
    name = entry.name
    if entry.worse or entry.old_verdict != entry.new_verdict:
        words = "worse" if entry.worse else "better" if entry.better else ""
        yield Line(
            name, "verdict", entry.old_verdict, entry.new_verdict, words, worse=bool(entry.worse)
        )
    for change in entry.settings:
        yield Line(name, change.what, _value(change.old), _value(change.new))
    for figure in entry.figures:
        yield _figure(name, figure)
    for reason in entry.reasons_gone:
        yield Line(name, "reason", reason, quantity.NONE, "gone")
    for reason in entry.reasons_new:
        yield Line(name, "reason", quantity.NONE, reason, "new")


def _figure(name: str, figure: FigureChange) -> Line:
    before, now = (quantity.with_unit(value, figure.unit) for value in (figure.old, figure.new))
    return Line(name, figure.what, before, now, _change(figure))


def _change(figure: FigureChange) -> str:
    """A factor, or where that is next to 1, the relative difference."""
    if figure.ratio is None:
        return quantity.NONE
    if abs(figure.ratio - 1.0) < 0.01:
        return f"{figure.ratio - 1.0:+.1e}"
    return f"{quantity.number(figure.ratio)}×"


def remarks(diff: Diff) -> Iterator[tuple[str, str]]:
    """What else is to be said of a scene: a subject, and a sentence of it."""
    if diff.sample:
        told = f"{_told(diff.sample)}; figures may differ through this alone"
        yield "not the same question", told
    yield "versions and machine", _told(diff.circumstances) or "the same"
    for which, found in (("the old", diff.only_old), ("the new", diff.only_new)):
        asked = [f"{one.name} ({one.verdict})" for one in found if not one.why]
        if asked:
            yield f"only in {which} one", ", ".join(asked)
        for one in found:
            if one.why:
                yield f"only in {which} one", f"{one.name} ({one.verdict}); {one.why}"
    for line in diff.better:
        yield "better", line


def conclusion(diff: Diff) -> str:
    """Say in one sentence what it comes to."""
    changed = sum(entry.changed for entry in diff.entries)
    times = sum(bool(entry.timings) for entry in diff.entries)
    total = len(diff.entries) + diff.unchanged
    return (
        f"of {total} compared, {len(diff.worse)} worse, {len(diff.better)} better, {changed} "
        f"changed, {times} with other times, {diff.unchanged} the same"
    )


def thresholds(comparison: Comparison) -> str:
    """Say what counts as a change."""
    return (
        f"figures of physics that differ by {comparison.rtol:g} or less, of themselves or of their "
        f"budget, are the same; so are times within a factor of {comparison.factor:g}, and no time "
        "makes a result worse"
    )


def _told(changes: tuple[Change, ...]) -> str:
    return ", ".join(f"{c.what} {_value(c.old)} → {_value(c.new)}" for c in changes)


def _value(value: Value) -> str:
    if value is None:
        return quantity.NONE
    return f"{value:g}" if isinstance(value, float) else str(value)
