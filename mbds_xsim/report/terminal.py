"""Reports in a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table as Grid
from rich.text import Text as Words

from mbds_xsim.base.process import discard, unwritten
from mbds_xsim.base.text import counted, printable
from mbds_xsim.report import blocks
from mbds_xsim.report.blocks import Cell, Column, Remark, Report, Row, Table

_PIPED = 160
"""Number of columns if the width is unknown."""
_WIDE = 104
"""Least width of a terminal that fits whole tables [columns]."""
_LEAST = 80
"""Least width of a table [columns]: a narrower terminal folds lines, and no figure is cut."""
_SHORT = 32
"""Longest text that is folded only where a table would not fit else; a figure never is."""
_GAPS = (2, 1)
"""Spaces between columns of a table: the usual one, and that of a table that is short of room."""
SIGNS = {"pass": "✓", "warn": "!", "fail": "✗", "over": "✗"}
_STYLES = {
    "pass": "bold green", "warn": "bold yellow", "fail": "bold red", "over": "bold red",
    "strong": "bold", "muted": "dim", "": "",
}  # fmt: skip


class Outlet(Console):
    """Standard output or error: text is data, and colour is used where it means something.

    If the reader hangs up or the disk is full, the output ends, not the work: results are still to
    be written to files.
    """

    def __init__(self, *, stderr: bool) -> None:
        super().__init__(stderr=stderr, markup=False, highlight=False, emoji=False)
        if self.width < 1 or (not self.is_terminal and "COLUMNS" not in os.environ):
            self.width = _PIPED  # a file has no edge to cut tables at

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Render text without its control characters."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)

    def on_broken_pipe(self) -> None:
        """Fall silent if the reader hangs up, as `… | head` does."""
        self.quiet = True
        discard(sys.stderr if self.stderr else sys.stdout)

    def _check_buffer(self) -> None:
        try:
            super()._check_buffer()
        except OSError as error:
            unwritten.append(error)
            self.on_broken_pipe()


def print_report(report: Report, console: Console | None = None) -> None:
    """Print a report, on standard output by default, with its conclusion last, where it is read."""
    console = console or Outlet(stderr=False)
    console.print()
    subtitle = "" if report.verdict else f": {report.what}"
    title = Words(f"{report.title}{subtitle}", style="bold")
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


def print_blocks(shown: Iterable[blocks.Block], console: Console) -> None:
    """Print the blocks that a terminal can show."""
    for block in shown:
        match block:
            case Table():
                _print_table(block, console)
            case blocks.Text():
                # A file has no edge: lines stay whole for those who search them.
                words = Words(block.text, style=_STYLES[block.mark])
                console.print(words, soft_wrap=not console.is_terminal)
            case blocks.Remarks():
                for remark in block.lines[: block.most]:
                    console.print(_remark(remark))
                _left_out(len(block.lines), block.most, "line", console)
            case blocks.Section() if "terminal" in block.on:
                print_blocks(block.blocks, console)


def _print_table(table: Table, console: Console) -> None:
    wide = console.width >= _WIDE
    columns = [k for k, column in enumerate(table.columns) if wide or column.narrow]
    rows = table.rows[: table.most]
    width, console.width = console.width, max(console.width, _LEAST)
    widths = [_widths(table.columns[k], [row.cells[k] for row in rows]) for k in columns]
    fitting, gap = _fitting(widths, console.width - 1)
    grid = Grid(
        title=table.title or None, title_justify="left", title_style="",
        box=box.SIMPLE_HEAD, padding=(0, gap - 1, 0, 0), pad_edge=False, header_style="bold",
    )  # fmt: skip
    for k, wanted in zip(columns, fitting, strict=True):
        column = table.columns[k]
        justify: Literal["left", "right"] = "left" if column.words else "right"
        grid.add_column(column.heading, justify=justify, width=wanted, overflow="fold")
    above = ""
    for row in rows:
        cells = [_words(row.cells[k]) for k in columns]
        if table.grouped and row.cells[0].text == above:
            cells[0] = Words("")
        above = row.cells[0].text
        grid.add_row(*cells, style=_STYLES[row.mark])
    console.width = max(console.width, 1 + sum(fitting) + gap * len(fitting))
    console.print(grid)
    console.width = width
    _left_out(len(table.rows), table.most, "row", console)
    for row in table.rows:
        if row.reasons:
            console.print(_reason(row))
    if table.note:
        console.print(Words(table.note, style="dim"))


def _widths(column: Column, cells: Sequence[Cell]) -> tuple[int, int, int]:
    """Return the least width of a column, that without folded short words, and that of all."""
    texts = [_words(cell).plain for cell in cells]
    heading = max(map(cell_len, column.heading.split()), default=0)
    longest = max(map(cell_len, texts), default=0)
    word = max((cell_len(word) for text in texts for word in text.split()), default=0)
    least = min(word, _SHORT) if column.words or longest > _SHORT else longest
    unfolded = min(longest, _SHORT)
    return max(least, heading), max(unfolded, heading), max(longest, cell_len(column.heading))


def _fitting(widths: Sequence[tuple[int, int, int]], room: int) -> tuple[list[int], int]:
    """Return widths of columns and the gap between them that fit into the room, if any do."""
    least, *wider = zip(*widths, strict=True)
    free = room - sum(least)
    gap = next((gap for gap in _GAPS if gap * len(least) <= free), 0)
    if not gap:  # the terminal folds the lines: columns that are folded, too, are hard to read
        return list(wider[0]), max(_GAPS)
    fitting, free = list(least), free - gap * len(least)
    for wanted in wider:
        for k, most in enumerate(wanted):
            more = min(free, most - fitting[k])
            fitting[k], free = fitting[k] + more, free - more
    return fitting, gap


def _words(cell: Cell) -> Words:
    sign = SIGNS.get(cell.mark, "")
    text = f"{cell.text}{sign}" if cell.mark == "over" else f"{sign} {cell.text}".strip()
    return Words(text, style=_STYLES[cell.mark])


def _reason(row: Row) -> Grid:
    """Lay out the first reason with a hanging indent, and the number of further reasons."""
    first, *rest = row.reasons
    more = f" (and {len(rest)} more)" if rest else ""
    return _hanging(
        Words(SIGNS.get(row.mark, "✗"), style=_STYLES[row.mark]),
        Words.assemble((" ".join(row.texts[:2]), "bold"), f": {first}", (more, "dim")),
    )


def _remark(remark: Remark) -> Grid:
    style = _STYLES[remark.mark] or "bold"
    sign = SIGNS.get(remark.mark, "·")
    return _hanging(Words(sign, style="dim"), Words.assemble((remark.begin, style), remark.text))


def _hanging(sign: Words, text: Words) -> Grid:
    line = Grid.grid(padding=(0, 1))
    line.add_row(sign, text)
    return line


def _left_out(count: int, most: int | None, noun: str, console: Console) -> None:
    if most is not None and count > most:
        text = f"{counted(count - most, f'more {noun}')}, which --json lists"
        console.print(_remark(Remark("and", text)))
