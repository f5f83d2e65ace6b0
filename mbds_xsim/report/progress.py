"""A progress bar for long work, with rate and time left."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

from mbds_xsim.report.bar import Bar

__all__ = ["ProgressBar"]


class ProgressBar(Bar):
    """Shows how many of the tasks are done, and what was done last."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            console,
            TextColumn("{task.description:<28}"),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            Elapsed(),
            TextColumn("left"),
            Remaining(),
            name="starting",
        )

    def begin(self, total: int, what: str = "running") -> None:
        """Say how many tasks there are, and what is done."""
        self._show(total=total, completed=0, description=what)

    def doing(self, what: str) -> None:
        """Say what is being done now."""
        self._show(description=what)

    def advance(self, what: str) -> None:
        """Count one task as done."""
        self._show(advance=1, description=what)
