"""Progress of long work: a line at the bottom of a terminal, elsewhere a line a minute in a log."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from mbds_xsim.base.text import on_a_line

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
            self._progress.console.print(Text(line))
        else:
            _log(line)

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

    def doing(self, what: str) -> None:
        """Say what is being done now."""
        self._show(description=what)

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

    def advance(self, done: int, rejected: int) -> None:
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
