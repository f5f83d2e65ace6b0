"""Run tasks side by side, each in a fresh process of its own.

An engine may crash its process, hang, or keep settings that outlive a disconnect: none of that
may touch another result. A fresh interpreter is used rather than a fork or `multiprocessing`'s
spawn, because engines do not survive the one and scripts without a main guard not the other.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mbds_xsim.base.process import Spent, held_back, memory_bytes

LIMIT = 3600.0
"""Longest that one piece of work may take where nothing else is asked for [s]."""

_POLL = 0.01
_START_UP = 600.0  # longest that a process may import what its task names [s]
_SHARE = 0.8  # of the machine's memory, for all processes together
_TAIL = 400  # characters of an engine's last words


@dataclass(frozen=True)
class Task:
    """A picklable function of a module, with its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    timeout: float = LIMIT
    """Of its own time [s]: neither the start of its process nor what other work on the machine
    keeps it from counts."""


@dataclass(frozen=True)
class Crash:
    """What a task left instead of an answer."""

    reason: str
    refused: bool = False
    """The task was refused by an `InputError`, whose text is the reason."""
    timed_out: bool = field(default=False, compare=False)
    """The task was ended at its time limit."""

    @property
    def kind(self) -> Literal["refused", "timed out", "crashed"]:
        """How it ended."""
        return "refused" if self.refused else "timed out" if self.timed_out else "crashed"


def begin(path: Path | None = None) -> None:
    """Say that the work proper of this process's task begins now, and its time from here on.

    The worker says so once what a task names is imported; a task may again, where it has loaded an
    engine, or goes on to its next part. Elsewhere it does nothing.

    Args:
        path: Of the file by which it is said, from now on.
    """
    global _begun
    _begun = path or _begun
    if _begun is not None:
        _begun.touch()


def in_worker() -> bool:
    """Say whether this process carries out a task of another."""
    return _begun is not None


_begun: Path | None = None


def core_count() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    started: Callable[[int], None] | None = None,
    finished: Callable[[int, Any], None] | None = None,
) -> list[Any]:
    """Carry out all tasks, in order of their listing as workers come free.

    Args:
        tasks: What to do; list the longest first.
        workers: Processes at a time; all cores when left out. 0 runs the tasks in this process,
            one after the other, for debuggers and for tests that change what a task does: there
            is no timeout then, and an error is raised where it happens.
        started: Called with a task's place as its process begins.
        finished: Called with a task's place and answer as each one ends.

    Returns:
        One answer a task, or a `Crash`.
    """
    if workers == 0:
        return [_run_here(place, task, started, finished) for place, task in enumerate(tasks)]
    answers: list[Any] = [None] * len(tasks)
    waiting = list(range(len(tasks)))[::-1]
    running: list[_Process] = []
    with (
        held_back() as let_through,
        tempfile.TemporaryDirectory(prefix="mbds-xsim-") as folder,
        _lifeline() as line,
    ):
        most = min(workers or core_count(), max(len(tasks), 1))
        memory = _SHARE * memory_bytes()
        try:
            while waiting or running:
                while waiting and len(running) < most:
                    place = waiting.pop()
                    running.append(_Process(place, tasks[place], Path(folder), line))
                    if started is not None:
                        started(place)
                if sum(process.bytes for process in running) > memory:
                    max(running, key=lambda process: process.bytes).end_for_memory()
                for process in [process for process in running if process.ended()]:
                    running.remove(process)
                    answers[process.place] = process.answer()
                    if finished is not None:
                        finished(process.place, answers[process.place])
                time.sleep(_POLL)
                let_through()
        finally:
            for process in running:
                process.kill()
    return answers


def _run_here(
    place: int,
    task: Task,
    started: Callable[[int], None] | None,
    finished: Callable[[int, Any], None] | None,
) -> Any:
    if started is not None:
        started(place)
    answer = task.function(*task.arguments)
    if finished is not None:
        finished(place, answer)
    return answer


@contextmanager
def _lifeline() -> Iterator[int]:
    """Give a pipe to read from that ends with this process, whatever ends it."""
    reading, writing = os.pipe()
    try:
        yield reading
    finally:
        os.close(writing)
        os.close(reading)


class _Process:
    """One task under way."""

    def __init__(self, place: int, task: Task, folder: Path, lifeline: int) -> None:
        self.place = place
        self._task = task
        self._answer = folder / f"{place}.answer"
        self._begun = folder / f"{place}.begun"
        self._words = folder / f"{place}.log"
        question = folder / f"{place}.task"
        question.write_bytes(pickle.dumps((task.function, task.arguments)))
        self._timed_out, self._took = False, 0
        threads = {key: "1" for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        with self._words.open("wb") as words:
            self._popen = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "mbds_xsim.base.worker",
                    question,
                    self._answer,
                    self._begun,
                ],
                stdin=lifeline,
                stdout=words,
                stderr=words,
                env=os.environ | threads,
                cwd=folder,  # engines drop log files where they stand
            )
        self._spent = Spent(self._popen.pid)
        self._limit, self._since = _START_UP, 0

    def ended(self) -> bool:
        if self._popen.poll() is None and self._spent.look():
            if self._begun.exists() and (since := self._begun.stat().st_mtime_ns) != self._since:
                self._limit, self._since = self._task.timeout, since
                self._spent.seconds = 0.0
            self._timed_out = self._spent.seconds > self._limit
            if self._timed_out:
                self.kill()
        return self._popen.poll() is not None

    @property
    def bytes(self) -> int:
        """Memory that it has."""
        return self._spent.bytes

    def end_for_memory(self) -> None:
        self._took = self.bytes
        self.kill()

    def kill(self) -> None:
        self._popen.kill()
        self._popen.wait()

    def answer(self) -> Any:
        if not self._answer.exists():
            return Crash(self._last_words(), timed_out=self._timed_out)
        try:
            kind, value = pickle.loads(self._answer.read_bytes())
        except Exception as error:  # it may hold what only that process could make
            return Crash(f"its answer cannot be read: {type(error).__name__}: {error}")
        return value if kind == "done" else Crash(value, refused=kind == "input error")

    def _last_words(self) -> str:
        if self._timed_out:
            return f"no answer within {self._limit:g} s" + ("" if self._since else " of starting")
        if self._took:
            return (
                f"it had taken {self._took / 2**30:.3g} GiB when the memory ran out; fewer "
                "--workers leave more to each"
            )
        code = self._popen.returncode
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        tail = self._words.read_text(errors="replace").strip()[-_TAIL:]
        last = tail.splitlines()[-1] if tail else "without a word"
        return f"the process crashed with {name}: {last}"
