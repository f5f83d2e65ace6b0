"""Tell progress from the curves that runs write, wherever they run."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from mbds_xsim.learn.curves import read_curve
from mbds_xsim.learn.runs import Run

__all__ = ["TrainingSink", "watched"]

_INTERVAL = 0.5  # [s]


class TrainingSink(Protocol):
    """Where progress is told."""

    def begin(self, done: int, most_steps: Sequence[int]) -> None:
        """Say how many runs are done, and the most steps of each that is not."""

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        """Tell how far a run is and its validation error; `before`: an earlier process got so
        far.
        """

    def ended(self, name: str, most_steps: int, how: str) -> None:
        """Tell of a run that is over."""


@contextmanager
def watched(runs: Sequence[Run], progress: TrainingSink) -> Iterator[None]:
    """Tell what is added to the curves of some runs while the block runs."""
    # A curve without a checkpoint is of a run that was removed, and is made anew.
    seen = {run.name: 0 if run.checkpoint.exists() else _changed(run) for run in runs}
    _tell(runs, seen, progress, before=True)
    over = threading.Event()

    def look() -> None:
        while not over.wait(_INTERVAL):
            _tell(runs, seen, progress)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _tell(
    runs: Sequence[Run], seen: dict[str, int], progress: TrainingSink, *, before: bool = False
) -> None:
    """Tell of the runs whose files are newer than when they were looked at last [ns]."""
    for run in runs:
        changed = _changed(run)
        if changed > seen[run.name]:
            seen[run.name] = changed
            points = read_curve(run.curve).points
            if points:
                progress.reached(run.name, points[-1].step, points[-1].error, before=before)


def _changed(run: Run) -> int:
    """When its curve was written last [ns]."""
    return run.curve.stat().st_mtime_ns if run.curve.exists() else 0
