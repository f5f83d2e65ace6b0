"""Progress of long work: a line on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, Self

from rich import progress
from rich.console import Console
from rich.text import Text as Words

from mbds_xsim.base.process import tell

_EVERY = 60.0  # between lines of a log [s]
_SPEED_OVER = 600.0  # work comes in bursts; rate and time left are averages over this time [s]


class _Remaining(progress.ProgressColumn):
    """Time left by the last news, counted down; unknown once it has passed."""

    def render(self, task: progress.Task) -> Words:
        """Return hours, minutes and seconds."""
        left = 0.0 if task.finished else task.fields["end"] - time.monotonic()
        known = 0.0 <= left < math.inf
        return Words(str(timedelta(seconds=math.ceil(left))) if known else "-:--:--")


_PARTS: dict[str, Callable[[], progress.ProgressColumn]] = {
    "bar": lambda: progress.BarColumn(bar_width=32),
    "count": progress.MofNCompleteColumn,
    "elapsed": progress.TimeElapsedColumn,
    "remaining": _Remaining,
}


class Bar:
    """Progress in one line on a terminal, gone at the end; elsewhere lines on standard error.

    Args:
        console: Console to show it on.
        parts: Columns, left to right: `bar`, `count`, `elapsed`, `remaining`, or a text with
            fields, such as `{rate}`; `{what}` is the current work.
        fields: Initial values of the fields.
    """

    def __init__(self, console: Console, *parts: str, what: str = "", **fields: Any) -> None:
        self._parts = [_PARTS[part]() if part in _PARTS else _text(part) for part in parts]
        self._on_terminal, self._ended = console.is_terminal, threading.Event()
        self._begin = time.monotonic()
        self._progress = progress.Progress(
            *self._parts,
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=_SPEED_OVER,
        )
        self._task = self._progress.add_task(what, total=None, end=math.inf, **fields)

    def __enter__(self) -> Self:
        self._progress.start()
        if not self._on_terminal:
            threading.Thread(target=self._write_log, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._progress.stop()

    def notice(self, line: str) -> None:
        """Print a line that stays: above the bar, or on standard error."""
        if self._on_terminal:
            self._progress.console.print(Words(line))
        else:
            tell(line)

    def doing(self, work: str) -> None:
        """Show the current work."""
        self._show(description=work)

    def forecast(self, left_s: float) -> None:
        """Ignore a forecast: the bar estimates the time left from its count."""

    def _write_log(self) -> None:
        """Log from time to time that work goes on, and how far it is."""
        while not self._ended.wait(_EVERY):
            (task,) = self._progress.tasks
            parts = (part for part in self._parts if not isinstance(part, progress.BarColumn))
            tell(" ".join(str(part.render(task)) for part in parts))

    def _spent(self) -> float:
        """Return the time since the beginning [s]."""
        return time.monotonic() - self._begin

    def _rate(self, count: int) -> str:
        return f"{count / max(self._spent(), 1e-9):.3g}"

    def _show(self, **fields: Any) -> None:
        self._progress.update(self._task, **fields)
        if not {"advance", "completed"}.isdisjoint(fields):
            left = self._progress.tasks[0].time_remaining
            self._end_in(math.inf if left is None else left)

    def _end_in(self, left_s: float) -> None:
        """Set the time left [s], infinite if unknown."""
        self._progress.update(self._task, end=time.monotonic() + left_s)


class ProgressBar(Bar):
    """Progress as the number of finished tasks, and the name of the last one."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            console, "{what:<28}", "bar", "count", "elapsed", "left", "remaining", what="starting"
        )

    def begin(self, total: int, work: str = "running") -> None:
        """Set the number of tasks, and name the work."""
        self._show(total=total, completed=0, description=work)

    def advance(self, work: str) -> None:
        """Count one task as done."""
        self._show(advance=1, description=work)


class StudyBar(Bar):
    """Progress by forecasts of the work left, counted down by the clock."""

    def __init__(self, console: Console, workers: int, subject: str) -> None:
        self._workers, self._points = workers, 0
        parts = ("{what:<44}", "bar", "{points} points", "elapsed", "left", "remaining")
        super().__init__(console, *parts, what=f"{subject}: reference", points=0)

    def begin(self, total: int) -> None:
        """Ignore the number of tasks: points are counted."""

    def forecast(self, left_s: float) -> None:
        """Set the work left [s of one worker]."""
        spent, remaining = self._spent(), left_s / self._workers
        self._show(completed=spent, total=spent + remaining)
        self._end_in(remaining)

    def advance(self, work: str) -> None:
        """Count one point as measured."""
        self._points += 1
        self._show(description=work, points=self._points)


class GeneratingBar(Bar):
    """Progress of data: trajectories made, rate, time left, and rejected trajectories."""

    def __init__(self, console: Console) -> None:
        self._made, self._rejected = 0, 0
        parts = ("{what}", "bar", "count", "{rate}", "left", "remaining", "{rejected} rejected")
        super().__init__(console, *parts, what="starting", rate="", rejected=0)

    def begin(self, total: int, done: int = 0) -> None:
        """Set the number of trajectories, and how many of them an earlier run has made."""
        self._show(total=total, completed=done, description="trajectories")

    def advance(self, work: str) -> None:
        """Count a task that precedes the trajectories, such as a search for settings."""
        self._show(advance=1, description=work)

    def made(self, done: int, rejected: int) -> None:
        """Count newly made trajectories, and how many of them were rejected."""
        self._made += done
        self._rejected += rejected
        rate = f"{self._rate(self._made)}/s"
        self._show(advance=done, rate=rate, rejected=self._rejected)


class TrainingBar(Bar):
    """Progress of training: steps, finished runs, steps per second, time left, last validation."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._steps: dict[str, int] = {}
        self._runs = self._done = self._taken = 0
        self._lock = threading.Lock()
        parts = ("bar", "{runs}", "{rate}", "left at most", "remaining", "{last}")
        super().__init__(console, *parts, runs="", rate="", last="")

    def begin(self, done: int, most_steps: Sequence[int]) -> None:
        """Set the number of finished runs, and the most steps of each other run."""
        self._runs, self._done = done + len(most_steps), done
        self._begin = time.monotonic()
        self._show(total=sum(most_steps), runs=self._count())

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        """Report how far a run is; steps of an earlier process do not count for the speed."""
        with self._lock:
            new = step - self._steps.get(name, 0)
            self._steps[name] = step
            self._taken += 0 if before else new
            last = f"{name}: {error:.3g} m² at {step}"
            self._show(advance=new, rate=f"{self._rate(self._taken)} steps/s", last=last)

    def ended(self, name: str, most_steps: int, how: str) -> None:
        """Report that a run is over, so that its other steps need not be taken."""
        with self._lock:
            self._done += 1
            remaining = most_steps - self._steps.get(name, 0)
            self._steps[name] = most_steps
            self._show(advance=remaining, runs=self._count())
        self._console.print(f"{name}: {how}", highlight=False, soft_wrap=True)
        self._console.file.flush()  # a log of days is read while it grows

    def _count(self) -> str:
        return f"{self._done}/{self._runs} runs"


def _text(form: str) -> progress.ProgressColumn:
    """Make a column that fills a text's fields with those of the task."""
    described = form.replace("{what", "{task.description")
    return progress.TextColumn(re.sub(r"\{(\w+)\}", r"{task.fields[\1]}", described), markup=False)
