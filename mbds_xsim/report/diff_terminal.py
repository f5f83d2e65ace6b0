"""A comparison on the terminal: what changed, what changed in time, what is worse."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.report import diff_summary as summary
from mbds_xsim.study.diff import Comparison, Diff

__all__ = ["print_comparison"]

_MOST_FIGURES, _MOST_TIMES = 40, 12
"""Rows of a table; Markdown and JSON have them all."""


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print for reading in ten seconds: the verdict comes last."""
    for diff in comparison.scenes:
        _print_scene(diff, console)
    for which, names in (
        ("the old", comparison.scenes_only_old),
        ("the new", comparison.scenes_only_new),
    ):
        if names:
            _remark(console, f"scenes only in {which} one", ", ".join(names))
    _remark(console, "counted", summary.thresholds(comparison))
    console.print()
    for diff in comparison.scenes:
        verdict = "WORSE" if diff.worse else "OK"
        style = "bold red reverse" if diff.worse else "bold green reverse"
        told = f": {summary.conclusion(diff)}"
        console.print(Text.assemble((f" {verdict} ", style), (f" {diff.scene}", "bold"), told))


def _print_scene(diff: Diff, console: Console) -> None:
    console.print()
    console.print(Text(diff.scene, style="bold"), highlight=False)
    for heading, lines, most in (
        ("what changed", summary.figure_lines(diff), _MOST_FIGURES),
        ("times", summary.time_lines(diff), _MOST_TIMES),
    ):
        if lines:
            console.print(_table(heading, lines[:most]))
        if len(lines) > most:
            _remark(console, "and", f"{len(lines) - most} rows more: --markdown or --json")
    for subject, text in summary.remarks(diff):
        _remark(console, subject, text)
    for line in diff.worse[:_MOST_FIGURES]:
        _remark(console, "worse", line, style="bold red")


def _table(heading: str, lines: list[summary.Line]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    for name in (heading, *summary.HEADINGS[1:]):
        table.add_column(name, justify="right" if name == "change" else "left", overflow="fold")
    above = ""
    for line in lines:
        entry = "" if line.entry == above else line.entry
        above = line.entry
        last = f"{line.cells[-1]} ✗" if line.worse else line.cells[-1]
        cells = (Text(cell) for cell in (entry, *line.cells[1:-1], last))
        table.add_row(*cells, style="bold red" if line.worse else "")
    return table


def _remark(console: Console, subject: str, text: str, style: str = "bold") -> None:
    line = Table.grid(padding=(0, 1))
    line.add_row(Text("·", style="dim"), Text.assemble((f"{subject}: ", style), text))
    console.print(line)
