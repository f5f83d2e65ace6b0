"""Progress of a study whose extent shows as it goes: points done, and the time left."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed

__all__ = ["StudyBar"]


class StudyBar:
    """Takes forecasts of the work left, and counts them down by the clock; quiet off a terminal."""

    def __init__(self, console: Console, workers: int, subject: str) -> None:
        self._workers = workers
        self._points = 0
        self._begin = time.monotonic()
        columns = (
            TextColumn("{task.description:<44}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[points]} points"),
            Elapsed(),
            TextColumn("{task.fields[left]}"),
        )
        self._progress = Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self._task = self._progress.add_task(f"{subject}: reference", total=None, points=0, left="")

    def __enter__(self) -> StudyBar:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def forecast(self, left_s: float) -> None:
        """Say how much work is left [s of one worker]."""
        spent, left = time.monotonic() - self._begin, left_s / self._workers
        self._progress.update(
            self._task, completed=spent, total=spent + left, left=f"{_told(left)} left"
        )

    def advance(self, what: str) -> None:
        """Count one point as measured."""
        self._points += 1
        self._progress.update(
            self._task,
            description=what,
            points=self._points,
            completed=time.monotonic() - self._begin,
        )


def _told(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
