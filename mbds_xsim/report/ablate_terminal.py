"""An ablation on the terminal: effects, model sizes, what it comes to."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.report import ablate_summary as summary
from mbds_xsim.study.ablate_result import Ablation, Row

__all__ = ["print_ablation"]

_WIDE = 118
"""Columns of a terminal from which on the whole table fits."""
_STYLES = {"needed": "bold green", "not needed": "bold yellow", "not possible": "dim"}


def print_ablation(ablation: Ablation, console: Console) -> None:
    """Print an ablation for reading in ten seconds."""
    console.print()
    title = Text(ablation.scene, style="bold")
    title.append(f"  {ablation.description}", style="dim not bold")
    console.print(title, highlight=False)
    console.print(_effects(ablation, wide=console.width >= _WIDE))
    _remark(console, "judge", summary.judge_line(ablation))
    _remark(console, "floor", summary.floor_line(ablation))
    for row in ablation.rows:
        if row.sentence and not _plain(row):
            _remark(console, f"{row.effect} {summary.made(row)}", row.sentence)
    for engine, reason in ablation.failed.items():
        _remark(console, f"{engine} failed", reason)
    for engine, reason in ablation.left_out.items():
        _remark(console, f"{engine} left out", reason)
    console.print(_sizes(ablation))
    _remark(console, "scene", summary.size_line(ablation))
    console.print()
    console.print(Text.assemble((ablation.scene, "bold"), f": {summary.conclusion(ablation)}"))


def _plain(row: Row) -> bool:
    """Whether the figures of a row say all that led to its verdict."""
    above = row.over_floor is not None and row.over_floor > 1.0
    return row.verdict == ("needed" if above else "not needed")


def _effects(ablation: Ablation, *, wide: bool) -> Table:
    columns = [column for column in summary.COLUMNS if wide or column.narrow]
    table = _table()
    for column in columns:
        justify = "left" if column.text else "right"
        table.add_column(column.heading, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    above = ""
    for row in ablation.rows:
        cells = [Text(column.cell(row)) for column in columns]
        cells[-1].stylize(_STYLES.get(row.verdict, ""))
        if row.effect == above:
            cells[0] = Text("")
        above = row.effect
        table.add_row(*cells)
    return table


def _sizes(ablation: Ablation) -> Table:
    table = _table()
    for heading in ("engine", "coordinates", "constraints", "contact pairs", ""):
        table.add_column(heading, justify="left" if heading in ("engine", "") else "right")
    for size in ablation.sizes:
        counts = (size.coordinates, size.constraints, size.contact_pairs)
        table.add_row(size.engine, *map(str, counts), summary.model(size))
    return table


def _table() -> Table:
    return Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")


def _remark(console: Console, subject: str, text: str) -> None:
    line = Table.grid(padding=(0, 1))
    line.add_row(Text("·", style="dim"), Text.assemble((f"{subject}: ", "bold"), text))
    console.print(line)
