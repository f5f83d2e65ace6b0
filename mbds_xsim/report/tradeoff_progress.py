"""Progress of a study whose extent shows as it goes: points done, and the time left."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed

from mbds_xsim.report.bar import Bar

__all__ = ["StudyBar"]


class StudyBar(Bar):
    """Takes forecasts of the work left, and counts them down by the clock."""

    def __init__(self, console: Console, workers: int, subject: str) -> None:
        self._workers = workers
        self._points = 0
        self._begin = time.monotonic()
        super().__init__(
            console,
            TextColumn("{task.description:<44}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[points]} points"),
            Elapsed(),
            TextColumn("{task.fields[left]}"),
            name=f"{subject}: reference",
            points=0,
            left="",
        )

    def forecast(self, left_s: float) -> None:
        """Say how much work is left [s of one worker]."""
        spent, left = time.monotonic() - self._begin, left_s / self._workers
        self._show(completed=spent, total=spent + left, left=f"{_told(left)} left")

    def advance(self, what: str) -> None:
        """Count one point as measured."""
        self._points += 1
        spent = time.monotonic() - self._begin
        self._show(description=what, points=self._points, completed=spent)


def _told(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
