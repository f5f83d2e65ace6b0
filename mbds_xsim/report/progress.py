"""A progress bar for long work, with rate and time left."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

__all__ = ["ProgressBar"]


class ProgressBar:
    """Shows how many of the tasks are done, and what was done last; quiet off a terminal."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description:<28}"),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            Elapsed(),
            TextColumn("left"),
            Remaining(),
        )
        self._progress = Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self._task = self._progress.add_task("starting", total=None)

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def begin(self, total: int) -> None:
        """Say how many tasks there are."""
        self._progress.update(self._task, total=total, description="running")

    def advance(self, what: str) -> None:
        """Count one task as done."""
        self._progress.update(self._task, advance=1, description=what)
