"""What is under way, told as it goes on, and what it took."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from mbds_xsim.base.isolate import Task, run_tasks

Account = defaultdict[str, float]
"""Seconds of processes, by what they did."""
PROCESSES = "processes"
"""What is spent on starting processes, importing engines, and passing tasks and answers."""


@dataclass(frozen=True)
class Piece:
    """A task, its name for people, and what becomes of its answer."""

    name: str
    of: str
    """What its time is counted as: an engine, the reference."""
    task: Task
    keep: Callable[[Any], None]


def carry_out(
    pieces: Sequence[Piece], watch: Watch, spent: Account, *, workers: int | None
) -> None:
    """Carry pieces of work out side by side, and keep their answers in their order.

    Args:
        pieces: What to do; those whose answers know their own time have it as `busy_s`.
        watch: Where it is told.
        spent: Seconds of processes by what they did, to which these are added.
        workers: Processes at a time; all cores when None, none but this one for 0.
    """
    running = Running(watch, [piece.name for piece in pieces])
    begun: dict[int, float] = {}

    def started(place: int) -> None:
        begun[place] = time.perf_counter()
        running.started(place)

    def finished(place: int, answer: Any) -> None:
        whole = time.perf_counter() - begun[place]
        own = min(whole, getattr(answer, "busy_s", whole))
        spent[pieces[place].of] += own
        spent[PROCESSES] += whole - own
        running.finished(place, answer)

    tasks = [piece.task for piece in pieces]
    answers = run_tasks(tasks, workers=workers, started=started, finished=finished)
    for piece, answer in zip(pieces, answers, strict=True):
        piece.keep(answer)


class ProgressSink(Protocol):
    """Where progress is told."""

    def begin(self, total: int) -> None:
        """Say how many tasks there are."""

    def advance(self, what: str) -> None:
        """Count one task as done."""


class Notices(ProgressSink, Protocol):
    """Where lines are told, too, that stay."""

    def notice(self, line: str) -> None:
        """Say what is to stay and be read."""


class Watch(Notices, Protocol):
    """Where is told, too, what is under way."""

    def doing(self, what: str) -> None:
        """Say what is being done now."""


@dataclass
class Running:
    """Names the tasks that are under way, the one that was begun first before all others.

    Args:
        watch: Where it is told.
        names: Of all tasks.
    """

    watch: Watch
    names: list[str]
    _now: list[int] = field(default_factory=list)

    def started(self, place: int) -> None:
        """Note that a task begins."""
        self._now.append(place)
        self.watch.doing(self._told())

    def finished(self, place: int, _answer: Any) -> None:
        """Note that a task has ended."""
        self._now.remove(place)
        self.watch.advance(self._told() or self.names[place])

    def _told(self) -> str:
        names = list(dict.fromkeys(self.names[place] for place in self._now))
        others = f" and {len(names) - 1} more" if names[1:] else ""
        return names[0] + others if names else ""
