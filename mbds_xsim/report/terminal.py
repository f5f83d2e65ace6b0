"""A validation on the terminal: one table, what failed and why, the verdict."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.report import summary
from mbds_xsim.report.summary import COLUMNS, Cell, Column
from mbds_xsim.result import EngineResult, Validation

__all__ = ["print_table"]

_WIDE = 104
"""Columns of a terminal from which on the whole table fits."""
_STYLES = {"pass": "bold green", "warn": "bold yellow", "fail": "bold red"}
_MARKS = {"pass": "✓", "warn": "!", "fail": "✗"}


def print_table(validation: Validation, console: Console) -> None:
    """Print a validation for reading in ten seconds."""
    console.print()
    console.print(_title(validation), highlight=False, soft_wrap=False)
    console.print(_table(validation, wide=console.width >= _WIDE))
    for result in validation.engines:
        if result.reasons:
            console.print(_reason(result))
    for subject, note in summary.remarks(validation):
        console.print(_remark(subject, note))
    for engine, reason in validation.left_out.items():
        console.print(_remark(f"{engine} left out", reason))
    console.print(_remark("reference", summary.reference_line(validation)))
    console.print(_remark("odd one out", summary.odd_one_out(validation)))
    console.print()
    console.print(_verdict_line(validation))


def _title(validation: Validation) -> Text:
    title = Text(validation.scene, style="bold")
    if validation.description:
        title.append(f"  {validation.description}", style="dim not bold")
    return title


def _table(validation: Validation, *, wide: bool) -> Table:
    columns = [column for column in COLUMNS if wide or column.narrow]
    padding = (0, 1, 0, 0) if wide else (0, 0)
    table = Table(box=box.SIMPLE_HEAD, padding=padding, pad_edge=False, header_style="bold")
    for column in columns:
        justify = "left" if column.text else "right"
        table.add_column(column.heading, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    table.add_column("", no_wrap=True)
    above = ""
    for result in validation.engines:
        cells = [_cell(column, result, validation) for column in columns]
        if result.engine == above:
            cells[0] = Text("")
        above = result.engine
        table.add_row(*cells, _verdict(result.verdict))
    return table


def _cell(column: Column, result: EngineResult, validation: Validation) -> Text:
    cell: Cell = column.cell(result, validation)
    return Text(f"{cell.text}✗", style="bold red") if cell.over else Text(cell.text)


def _verdict(verdict: str) -> Text:
    return Text(f"{_MARKS.get(verdict, '?')} {verdict}", style=_STYLES.get(verdict, ""))


def _reason(result: EngineResult) -> Table:
    """First reason behind a hanging indent, and how many more there are."""
    first, *rest = result.reasons
    more = f" (and {len(rest)} more)" if rest else ""
    line = Table.grid(padding=(0, 1))
    mark = Text(_MARKS.get(result.verdict, "?"), style=_STYLES.get(result.verdict, ""))
    line.add_row(mark, Text.assemble((summary.label(result), "bold"), f": {first}", (more, "dim")))
    return line


def _remark(subject: str, text: str) -> Table:
    line = Table.grid(padding=(0, 1))
    line.add_row(Text("·", style="dim"), Text.assemble((f"{subject}: ", "bold"), text))
    return line


def _verdict_line(validation: Validation) -> Text:
    style = _STYLES.get(validation.verdict, "bold")
    return Text.assemble(
        (f" {validation.verdict.upper()} ", f"{style} reverse"),
        (f" {validation.scene}", "bold"),
        f": {summary.conclusion(validation)}",
    )
