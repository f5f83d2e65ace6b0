"""Reports of a comparison of two results, one for each scene."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from mbds_xsim.report import blocks, quantity
from mbds_xsim.studies.diff import Value, compare
from mbds_xsim.studies.diff.compare import Change, Comparison, Diff, EntryDiff, FigureChange

_HEADINGS = ("entry", "what", "before", "now", ">change")
_MOST_FIGURES, _MOST_TIMES = 40, 12
"""Most rows of a table on a terminal; Markdown and JSON have them all."""


def present(comparison: Comparison) -> Iterator[blocks.Report]:
    """Report for each scene what changed, and whether anything is worse."""
    sides = (("old", comparison.scenes_only_old), ("new", comparison.scenes_only_new))
    apart = blocks.Remarks.of(
        (f"scenes only in the {which} one", ", ".join(names)) for which, names in sides if names
    )
    for diff in comparison.scenes:
        first = (apart,) if diff is comparison.scenes[0] else ()
        yield blocks.Report(
            title=diff.scene,
            what="worse" if diff.worse else "nothing worse",
            conclusion=_conclusion(diff),
            blocks=(*first, *_blocks(diff, comparison)),
            command=_command(comparison),
            verdict="fail" if diff.worse else "pass",
        )


def _command(comparison: Comparison) -> str:
    words = ["mbds-xsim", "diff", comparison.old, comparison.new]
    if comparison.rtol != compare.RTOL:
        words += ["--rtol", str(comparison.rtol)]
    if comparison.factor != compare.FACTOR:
        words += ["--factor", str(comparison.factor)]
    return shlex.join(words)


def _blocks(diff: Diff, comparison: Comparison) -> Iterator[blocks.Block]:
    figures = [row for entry in diff.entries for row in _entry_rows(entry)]
    times = [_figure(e.name, change) for e in diff.entries for change in e.timings]
    for title, rows, most in (
        ("What changed", figures, _MOST_FIGURES),
        ("Times", times, _MOST_TIMES),
    ):
        if rows:
            table = blocks.table_of(_HEADINGS, rows, most=most, grouped=True)
            yield blocks.Section(title, (table,))
    yield blocks.Remarks.of(_remarks(diff))
    yield blocks.Remarks(
        tuple(blocks.Remark("worse", line, "fail") for line in diff.worse), _MOST_FIGURES
    )
    commands = f"old: {diff.old_command}; new: {diff.new_command}"
    yield blocks.Remarks.of([("compared", commands), ("counted", _thresholds(comparison))])


def _entry_rows(entry: EntryDiff) -> Iterator[blocks.Row]:
    name = entry.name
    if entry.worse or entry.old_verdict != entry.new_verdict:
        words = "worse" if entry.worse else "better" if entry.better else ""
        texts = (name, "verdict", entry.old_verdict, entry.new_verdict, words)
        yield blocks.row_of(texts, "over" if entry.worse else "")
    for change in entry.settings:
        yield blocks.row_of((name, change.what, _value(change.old), _value(change.new), ""))
    for figure in entry.figures:
        yield _figure(name, figure)
    for reason in entry.reasons_gone:
        yield blocks.row_of((name, "reason", reason, quantity.NONE, "gone"))
    for reason in entry.reasons_new:
        yield blocks.row_of((name, "reason", quantity.NONE, reason, "new"))


def _figure(name: str, figure: FigureChange) -> blocks.Row:
    before, now = (quantity.with_unit(value, figure.unit) for value in (figure.old, figure.new))
    return blocks.row_of((name, figure.what, before, now, _change(figure)))


def _change(figure: FigureChange) -> str:
    """Write the factor, or the relative difference if the factor is close to 1."""
    if figure.ratio is None:
        return quantity.NONE
    if abs(figure.ratio - 1.0) < 0.1:  # two digits of the factor would read 1
        return f"{figure.ratio - 1.0:+.1e}"
    return f"{quantity.number(figure.ratio)}×"


def _remarks(diff: Diff) -> Iterator[tuple[str, str]]:
    """Yield further remarks on a scene, each a subject and a sentence about it."""
    if diff.sample:
        text = f"{_describe_changes(diff.sample)}; figures may differ through this alone"
        yield "not the same question", text
    yield "versions and machine", _describe_changes(diff.circumstances) or "the same"
    for which, entries in (("the old", diff.only_old), ("the new", diff.only_new)):
        asked = [f"{one.name} ({one.verdict})" for one in entries if not one.why]
        if asked:
            yield f"only in {which} one", ", ".join(asked)
        for one in entries:
            if one.why:
                yield f"only in {which} one", f"{one.name} ({one.verdict}); {one.why}"
    for line in diff.better:
        yield "better", line


def _conclusion(diff: Diff) -> str:
    changed = sum(entry.changed for entry in diff.entries)
    times = sum(bool(entry.timings) for entry in diff.entries)
    total = len(diff.entries) + diff.unchanged
    return (
        f"{len(diff.worse)} worse, {len(diff.better)} better; of {total} compared {changed} "
        f"changed, {times} with other times, {diff.unchanged} the same"
    )


def _thresholds(comparison: Comparison) -> str:
    """State which differences count as changes."""
    return (
        f"figures of physics that differ by {comparison.rtol:g} or less, of themselves or of their "
        f"budget, are the same; so are times within a factor of {comparison.factor:g}, and no time "
        "makes a result worse"
    )


def _describe_changes(changes: tuple[Change, ...]) -> str:
    return ", ".join(f"{c.what} {_value(c.old)} → {_value(c.new)}" for c in changes)


def _value(value: Value) -> str:
    if value is None:
        return quantity.NONE
    return f"{value:g}" if isinstance(value, float) else str(value)
