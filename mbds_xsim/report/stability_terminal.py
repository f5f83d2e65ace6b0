"""A stability study on the terminal: the largest stable steps, or what one cell came to."""

from __future__ import annotations

from collections.abc import Iterable

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.counted import counted
from mbds_xsim.report import quantity
from mbds_xsim.report import stability_summary as summary
from mbds_xsim.study.stability.definition import Study, text_of
from mbds_xsim.study.stability.rows import Cell, Sweep

__all__ = ["print_cells", "print_list", "print_sweep"]


def print_list(studies: Iterable[Study], console: Console) -> None:
    """Print the studies there are, one line each."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for heading in ("study", "what is swept", "values", "what it is about"):
        table.add_column(heading)
    for study in studies:
        values = ", ".join(text_of(value) for value in study.values)
        swept = f"{study.quantity} [{study.unit}]" if study.unit else study.quantity
        table.add_row(Text(study.name, style="bold"), Text(swept), values, study.sentence)
    console.print(table)


def print_sweep(sweep: Sweep, console: Console) -> None:
    """Print a study for reading in ten seconds."""
    console.print()
    title = Text(sweep.study, style="bold")
    title.append(f"  {sweep.sentence}", style="dim not bold")
    console.print(title, highlight=False)
    console.print(Text(f"Largest stable step [ms], by {summary.swept(sweep)}"), highlight=False)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    table.add_column("engine and method", no_wrap=True)
    for value in sweep.values:
        table.add_column(text_of(value), justify="right", no_wrap=True)
    for panel in sweep.panels:
        table.add_row(panel.name, *(summary.limit(panel, row) for row in range(len(sweep.values))))
    console.print(table)
    _remark(console, "reading", summary.reading(sweep))
    _remark(console, "stable", sweep.criteria.removeprefix("stable: "))
    for name, text in summary.breaking(sweep):
        _remark(console, name, text)
    for name, text in summary.holding(sweep):
        _remark(console, name, text)
    if summary.learned_told(sweep):
        _remark(console, "trained models", summary.learned_told(sweep))
    for name, reason in sweep.left_out.items():
        _remark(console, f"{name} left out", reason)
    for name, reason in sweep.unknown.items():
        _remark(console, f"no reference at {name}", reason)
    made = f"{counted(sweep.measured, 'cell')} measured, {sweep.kept} kept from earlier"
    _remark(console, "made", f"{made}, {quantity.span(sweep.wall_s)} on {sweep.machine}")
    console.print()
    console.print(Text.assemble((sweep.study, "bold"), f": {summary.conclusion(sweep)}"))


def print_cells(sweep: Sweep, console: Console) -> None:
    """Print what happened in each cell of a few, and why."""
    for cell in sweep.cells:
        console.print()
        console.print(Text(summary.name_of(cell, sweep), style="bold"), highlight=False)
        for subject, text in summary.told(cell, sweep):
            _remark(console, subject, text, style=_style(cell) if subject == "outcome" else "bold")
    console.print()
    _remark(console, "stable", sweep.criteria.removeprefix("stable: "))
    for name, reason in sweep.left_out.items():
        _remark(console, f"{name} left out", reason)


def _style(cell: Cell) -> str:
    return "bold red" if cell.failed else "bold"


def _remark(console: Console, subject: str, text: str, style: str = "bold") -> None:
    line = Table.grid(padding=(0, 1))
    line.add_row(Text("·", style="dim"), Text.assemble((f"{subject}: ", style), text))
    console.print(line)
