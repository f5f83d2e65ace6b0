"""A trade-off study on the terminal: one table, what it comes to, what failed."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.report import quantity
from mbds_xsim.report import tradeoff_summary as summary
from mbds_xsim.report.learned_summary import model_columns, models_told
from mbds_xsim.study.rows import Tradeoff

__all__ = ["print_tradeoff"]

_WIDE = 104
"""Columns of a terminal from which on the whole table fits."""
_MOST_LINES = 8
"""Failures that are listed; the page and the JSON have them all."""


def print_tradeoff(study: Tradeoff, console: Console) -> None:
    """Print a study for reading in ten seconds."""
    console.print()
    title = Text(study.scene, style="bold")
    title.append(f"  {study.description}", style="dim not bold")
    console.print(title, highlight=False)
    console.print(_table(study, wide=console.width >= _WIDE))
    if study.models:
        console.print(_models(study, wide=console.width >= _WIDE))
        _remark(console, "trained models", models_told(study))
    _remark(console, "error", summary.what_is_charted(study))
    for line in summary.options_that_pay(study):
        _remark(console, "option that pays", line)
    failed = summary.failures(study)
    for name, steps, what in failed[:_MOST_LINES]:
        _remark(console, name, f"{steps}: {what}", style="bold red")
    if len(failed) > _MOST_LINES:
        _remark(console, "and", f"{len(failed) - _MOST_LINES} more lines, see the page or JSON")
    for reason in study.left_out.values():
        _remark(console, "left out", reason)
    measured = f"{study.measured} points × starts measured, {study.kept} kept from earlier"
    _remark(
        console,
        "made",
        f"{measured}, {quantity.span(study.wall_s)} on {summary.machine_told(study)}",
    )
    console.print()
    console.print(Text.assemble((study.scene, "bold"), f": {summary.conclusion(study)}"))


def _table(study: Tradeoff, *, wide: bool) -> Table:
    columns = [column for column in summary.columns(study) if wide or column.narrow]
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column.heading, justify="left" if column.text else "right", no_wrap=True)
    above = ""
    for curve in summary.main_curves(study):
        cells = [column.cell(curve) for column in columns]
        style = "dim" if curve.variation else ""
        if curve.engine == above:
            cells[0] = ""
        above = curve.engine
        table.add_row(*cells, style=style)
    return table


def _models(study: Tradeoff, *, wide: bool) -> Table:
    columns = [column for column in model_columns(study) if wide or column.narrow]
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column.heading, justify="left" if column.text else "right", no_wrap=True)
    for model in study.models:
        table.add_row(*(column.cell(model) for column in columns))
    return table


def _remark(console: Console, subject: str, text: str, style: str = "bold") -> None:
    line = Table.grid(padding=(0, 1))
    line.add_row(Text("·", style="dim"), Text.assemble((f"{subject}: ", style), text))
    console.print(line)
