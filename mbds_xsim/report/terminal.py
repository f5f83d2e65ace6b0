"""Where people read, and reports there: tables, remarks, the conclusion last."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table as Grid
from rich.text import Text as Words

from mbds_xsim.base.text import printable
from mbds_xsim.report.blocks import (
    Block,
    Cell,
    Column,
    Remark,
    Remarks,
    Report,
    Section,
    Table,
    Text,
)

_PIPED = 160
"""Columns where nobody says how many there are."""
_WIDE = 104
"""Columns of a terminal from which on whole tables fit."""
_LEAST = 80
"""Columns that a table takes at least: no figure is cut where a narrow terminal folds lines."""
_SHORT = 32
"""Longest text of a column that is never folded."""
SIGNS = {"pass": "✓", "warn": "!", "fail": "✗", "over": "✗"}
_STYLES = {
    "pass": "bold green", "warn": "bold yellow", "fail": "bold red", "over": "bold red",
    "strong": "bold", "muted": "dim", "": "",
}  # fmt: skip


class Outlet(Console):
    """Standard output or error: text is data, and colour is used where it means something.

    A reader that hangs up ends the telling, not the work.
    """

    def __init__(self, *, stderr: bool) -> None:
        super().__init__(stderr=stderr, markup=False, highlight=False, emoji=False)
        if self.width < 1 or (not self.is_terminal and "COLUMNS" not in os.environ):
            self.width = _PIPED  # a file has no edge to cut tables at

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Render, without what text in it would make a terminal do."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)

    def on_broken_pipe(self) -> None:
        """Fall silent: results are still to be written to files (`… | head`)."""
        self.quiet = True
        stream = sys.stderr if self.stderr else sys.stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def print_report(report: Report, console: Console) -> None:
    """Print a report, its conclusion last: there it is read."""
    console.print()
    asked = "" if report.verdict else f": {report.what}"
    title = Words(f"{report.title}{asked}", style="bold")
    title.append(f"  {report.description}" if report.description else "", style="dim not bold")
    console.print(title, highlight=False)
    print_blocks(report.blocks, console)
    if report.made:
        console.print(_remark(Remark("made", report.made)))
    console.print()
    badge = f" {report.what.upper()} " if report.verdict else ""
    console.print(
        Words.assemble(
            (badge, f"{_STYLES[report.verdict]} reverse"),
            (f"{' ' if badge else ''}{report.title}", "bold"),
            f": {report.conclusion}",
        )
    )


def print_blocks(blocks: Iterable[Block], console: Console) -> None:
    """Print those blocks that a terminal can show."""
    for block in blocks:
        match block:
            case Table():
                _print_table(block, console)
            case Text():
                # A file has no edge: lines stay whole for those who search them.
                words = Words(block.text, style=_STYLES[block.mark])
                console.print(words, soft_wrap=not console.is_terminal)
            case Remarks():
                for remark in block.lines[: block.most]:
                    console.print(_remark(remark))
                _left_out(len(block.lines), block.most, "lines", console)
            case Section() if "terminal" in block.on:
                print_blocks(block.blocks, console)


def _print_table(table: Table, console: Console) -> None:
    wide = console.width >= _WIDE
    shown = [k for k, column in enumerate(table.columns) if wide or column.narrow]
    grid = Grid(
        title=table.title or None, title_justify="left", title_style="",
        box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold",
    )  # fmt: skip
    for k in shown:
        longest = max((len(row.cells[k].text) for row in table.rows), default=0)
        _add_column(grid, table.columns[k], whole=longest <= _SHORT)
    above = ""
    for row in table.rows[: table.most]:
        cells = [_words(row.cells[k]) for k in shown]
        if table.grouped and row.cells[0].text == above:
            cells[0] = Words("")
        above = row.cells[0].text
        grid.add_row(*cells, style=_STYLES[row.mark])
    width, console.width = console.width, max(console.width, _LEAST)
    console.print(grid)
    console.width = width
    _left_out(len(table.rows), table.most, "rows", console)
    for row in table.rows:
        if row.reasons:
            console.print(_reason(row.cells, row.mark, row.reasons))
    if table.note:
        console.print(Words(table.note, style="dim"))


def _add_column(grid: Grid, column: Column, *, whole: bool) -> None:
    grid.add_column(
        column.heading,
        justify="left" if column.words else "right",
        no_wrap=whole or not column.words,
        overflow="fold",
    )


def _words(cell: Cell) -> Words:
    sign = SIGNS.get(cell.mark, "")
    text = f"{cell.text}{sign}" if cell.mark == "over" else f"{sign} {cell.text}".strip()
    return Words(text, style=_STYLES[cell.mark])


def _reason(cells: tuple[Cell, ...], mark: str, reasons: tuple[str, ...]) -> Grid:
    """First reason behind a hanging indent, and how many more there are."""
    first, *rest = reasons
    name = " ".join(cell.text for cell in cells[:2])
    more = f" (and {len(rest)} more)" if rest else ""
    return _hanging(
        Words(SIGNS.get(mark, "✗"), style=_STYLES[mark]),
        Words.assemble((name, "bold"), f": {first}", (more, "dim")),
    )


def _remark(remark: Remark) -> Grid:
    style = _STYLES[remark.mark] or "bold"
    sign = SIGNS.get(remark.mark, "·")
    return _hanging(Words(sign, style="dim"), Words.assemble((remark.begin, style), remark.text))


def _hanging(sign: Words, text: Words) -> Grid:
    line = Grid.grid(padding=(0, 1))
    line.add_row(sign, text)
    return line


def _left_out(count: int, most: int | None, what: str, console: Console) -> None:
    if most is not None and count > most:
        told = f"{count - most} more {what}, in the page, Markdown or JSON"
        console.print(_remark(Remark("and", told)))
