"""What all progress bars share: they live in a `with`; off a terminal they are a line a minute."""

from __future__ import annotations

import sys
import threading
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.text import Text

from mbds_xsim.safe_text import on_a_line

__all__ = ["Bar"]

_EVERY = 60.0  # off a terminal [s]
_SPEED_OVER = 600.0  # work comes in bursts; rate and time left look back over so long [s]


class Bar:
    """One line on a terminal, gone when the work is done; elsewhere lines on standard error."""

    def __init__(
        self, console: Console, *columns: ProgressColumn, name: str = "", **fields: Any
    ) -> None:
        for column in columns:
            if isinstance(column, TextColumn):
                column.markup = False
        self._columns = [column for column in columns if not isinstance(column, BarColumn)]
        self._seen, self._ended = console.is_terminal, threading.Event()
        self._progress = Progress(
            *columns,
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=_SPEED_OVER,
        )
        self._task = self._progress.add_task(name, total=None, **fields)

    def __enter__(self) -> Self:
        self._progress.start()
        if not self._seen:
            threading.Thread(target=self._tell, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._progress.stop()

    def notice(self, line: str) -> None:
        """Say what is to stay and be read: above the bar, or on standard error."""
        if self._seen:
            self._progress.console.print(Text(line))
        else:
            _log(line)

    def _tell(self) -> None:
        """Show in a log that work goes on, and how far it is."""
        while not self._ended.wait(_EVERY):
            (task,) = self._progress.tasks
            words = (str(column.render(task)) for column in self._columns)
            _log(" ".join(words))

    def _show(self, **what: Any) -> None:
        self._progress.update(self._task, **what)


def _log(line: str) -> None:
    print(f"mbds-xsim: {on_a_line(line)}", file=sys.stderr, flush=True)
