"""Where people read: reports in a terminal, and the progress of long work."""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Self

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.table import Table as Grid
from rich.text import Text as Words

from mbds_xsim.base.text import on_a_line, printable
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


_EVERY = 60.0  # off a terminal [s]
_SPEED_OVER = 600.0  # work comes in bursts; rate and time left look back over so long [s]


_PARTS: dict[str, Callable[[], ProgressColumn]] = {
    "bar": lambda: BarColumn(bar_width=32),
    "count": MofNCompleteColumn,
    "elapsed": TimeElapsedColumn,
    "remaining": TimeRemainingColumn,
}


class Bar:
    """One line on a terminal, gone when the work is done; elsewhere lines on standard error.

    Args:
        console: Where it is shown.
        parts: From left to right: `bar`, `count`, `elapsed`, `remaining`, or a text with fields, as
            `{rate}`; `{what}` is what is being done.
        fields: First values of the fields.
    """

    def __init__(self, console: Console, *parts: str, what: str = "", **fields: Any) -> None:
        self._parts = [_PARTS[part]() if part in _PARTS else _text(part) for part in parts]
        self._on_terminal, self._ended = console.is_terminal, threading.Event()
        self._begin = time.monotonic()
        self._progress = Progress(
            *self._parts,
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=_SPEED_OVER,
        )
        self._task = self._progress.add_task(what, total=None, **fields)

    def __enter__(self) -> Self:
        self._progress.start()
        if not self._on_terminal:
            threading.Thread(target=self._write_log, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._progress.stop()

    def notice(self, line: str) -> None:
        """Say what is to stay and be read: above the bar, or on standard error."""
        if self._on_terminal:
            self._progress.console.print(Words(line))
        else:
            _log(line)

    def doing(self, what: str) -> None:
        """Say what is being done now."""
        self._show(description=what)

    def forecast(self, left_s: float) -> None:
        """Pass over what the bar tells itself by what it counts."""

    def _write_log(self) -> None:
        """Show in a log that work goes on, and how far it is."""
        while not self._ended.wait(_EVERY):
            (task,) = self._progress.tasks
            parts = (part for part in self._parts if not isinstance(part, BarColumn))
            words = (str(part.render(task)) for part in parts)
            _log(" ".join(words))

    def _spent(self) -> float:
        """Time since the beginning [s]."""
        return time.monotonic() - self._begin

    def _rate(self, count: int) -> str:
        return f"{count / max(self._spent(), 1e-9):.3g}"

    def _show(self, **what: Any) -> None:
        self._progress.update(self._task, **what)


class ProgressBar(Bar):
    """Shows how many of the tasks are done, and what was done last."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            console, "{what:<28}", "bar", "count", "elapsed", "left", "remaining", what="starting"
        )

    def begin(self, total: int, what: str = "running") -> None:
        """Say how many tasks there are, and what is done."""
        self._show(total=total, completed=0, description=what)

    def advance(self, what: str) -> None:
        """Count one task as done."""
        self._show(advance=1, description=what)


class StudyBar(Bar):
    """Takes forecasts of the work left, and counts them down by the clock."""

    def __init__(self, console: Console, workers: int, subject: str) -> None:
        self._workers, self._points = workers, 0
        parts = ("{what:<44}", "bar", "{points} points", "elapsed", "{time_left}")
        first = f"{subject}: reference"
        super().__init__(console, *parts, what=first, points=0, time_left="")

    def begin(self, total: int) -> None:
        """Pass over how many tasks there are: points are counted."""

    def forecast(self, left_s: float) -> None:
        """Say how much work is left [s of one worker]."""
        spent, left = self._spent(), left_s / self._workers
        words = f"{left:.0f} s left" if left < 90 else f"{left / 60:.0f} min left"
        self._show(completed=spent, total=spent + left, time_left=words)

    def advance(self, what: str) -> None:
        """Count one point as measured."""
        self._points += 1
        self._show(description=what, points=self._points, completed=self._spent())


class GeneratingBar(Bar):
    """Shows trajectories made, rate, time left, and rejected ones."""

    def __init__(self, console: Console) -> None:
        self._made, self._rejected = 0, 0
        parts = ("bar", "count", "{rate}", "left", "remaining", "{rejected} rejected")
        super().__init__(console, *parts, rate="", rejected=0)

    def begin(self, total: int, done: int = 0) -> None:
        """Say how many trajectories there are, and how many an earlier run has made."""
        self._show(total=total, completed=done)

    def advance(self, what: str) -> None:
        """Count what is found before any trajectory is made."""
        del what
        self.made(1, 0)

    def made(self, done: int, rejected: int) -> None:
        """Count trajectories that were made since, and how many of them were rejected."""
        self._made += done
        self._rejected += rejected
        rate = f"{self._rate(self._made)}/s"
        self._show(advance=done, rate=rate, rejected=self._rejected)


class TrainingBar(Bar):
    """Shows steps, runs done, steps a second, time left, and the last validation."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._steps: dict[str, int] = {}
        self._runs = self._done = self._taken = 0
        self._lock = threading.Lock()
        parts = ("bar", "{runs}", "{rate}", "left at most", "remaining", "{last}")
        super().__init__(console, *parts, runs="", rate="", last="")

    def begin(self, done: int, most_steps: Sequence[int]) -> None:
        """Say how many runs are done, and the most steps of each that is not."""
        self._runs, self._done = done + len(most_steps), done
        self._begin = time.monotonic()
        self._show(total=sum(most_steps), runs=self._count())

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        """Tell how far a run is; steps of an earlier process are no speed of this one."""
        with self._lock:
            new = step - self._steps.get(name, 0)
            self._steps[name] = step
            self._taken += 0 if before else new
            last = f"{name}: {error:.3g} m² at {step}"
            self._show(advance=new, rate=f"{self._rate(self._taken)} steps/s", last=last)

    def ended(self, name: str, most_steps: int, how: str) -> None:
        """Tell of a run that is over, whose other steps need not be taken."""
        with self._lock:
            self._done += 1
            left = most_steps - self._steps.get(name, 0)
            self._steps[name] = most_steps
            self._show(advance=left, runs=self._count())
        self._console.print(f"{name}: {how}", highlight=False, soft_wrap=True)
        self._console.file.flush()  # a log of days is read while it grows

    def _count(self) -> str:
        return f"{self._done}/{self._runs} runs"


def _text(form: str) -> ProgressColumn:
    """Fill a text's fields from those of the task."""
    described = form.replace("{what", "{task.description")
    return TextColumn(re.sub(r"\{(\w+)\}", r"{task.fields[\1]}", described), markup=False)


def _log(line: str) -> None:
    print(f"mbds-xsim: {on_a_line(line)}", file=sys.stderr, flush=True)
