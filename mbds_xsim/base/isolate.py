"""Run tasks side by side, each in a fresh process of its own.

An engine may crash its process, hang, or keep settings that outlive a disconnect: none of that
may touch another result. The processes are forks of one that has imported no engine, since engines
do not survive a fork; `multiprocessing` is not used, since it imports a user's script once more in
each process, which a script without a main guard does not survive.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from mbds_xsim.base.process import Spent, held_back, memory_bytes
from mbds_xsim.base.text import in_utf8

LIMIT = 3600.0
"""Longest that one piece of work may take where nothing else is asked for [s]."""

_POLL_MS = 10  # longest wait for what the starter says
_START_UP = 600.0  # longest that a process may import what its task names [s]
_SHARE = 0.8  # of the machine's memory, for all processes together
_KEPT = 2**29  # bytes of an array, up to which its memory is used again
_TAIL = 400  # characters of an engine's last words


@dataclass(frozen=True)
class Task:
    """A picklable function of a module, with its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    timeout: float = LIMIT
    """Of its own time [s]: neither the start of its process nor what other work on the machine
    keeps it from counts."""
    after: int | None = None
    """Place, among the tasks carried out with it, of one that has to end before."""


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


class Carrier(Protocol):
    """What carries tasks out: `run_tasks`, or a cluster."""

    def __call__(
        self,
        tasks: Sequence[Task],
        *,
        workers: int | None = None,
        finished: Callable[[int, Any], None] | None = None,
    ) -> list[Any]:
        """Give one answer a task, or a `Crash`; in the order of the tasks."""


def run_tasks(
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    started: Callable[[int], None] | None = None,
    finished: Callable[[int, Any], None] | None = None,
    packages: Path | None = None,
) -> list[Any]:
    """Carry out all tasks, in order of their listing as workers come free.

    Args:
        tasks: What to do; list the longest first, and what others wait for before these.
        workers: Processes at a time; all cores when left out. 0 runs the tasks in this process,
            one after the other, for debuggers and for tests that change what a task does: there
            is no timeout then, and an error is raised where it happens.
        started: Called with a task's place as its process begins.
        finished: Called with a task's place and answer as each one ends, in place of the next
            process, which waits for it to return; so no more of them work than were asked for.
        packages: Folder whose packages the processes have in place of this one's.

    Returns:
        One answer a task, or a `Crash`.
    """
    if workers == 0:
        return [_run_here(place, task, started, finished) for place, task in enumerate(tasks)]
    answers: list[Any] = [None] * len(tasks)
    if not tasks:
        return answers
    waiting = list(range(len(tasks)))
    ended: set[int | None] = {None}
    running: list[_Process] = []
    with (
        held_back() as held,
        tempfile.TemporaryDirectory(prefix="mbds-xsim-") as folder,
    ):
        starter = _Starter(tasks, Path(folder), packages)
        most = min(workers or core_count(), len(tasks))
        memory = _SHARE * memory_bytes()
        try:
            while waiting or running:
                while len(running) < most and (ready := _ready(tasks, waiting, ended)):
                    waiting.remove(place := ready[0])
                    if starter.over:  # something has killed it
                        starter.end()
                        starter = _Starter(tasks, Path(folder), packages)
                    running.append(_Process(place, tasks[place], starter))
                    if started is not None:
                        started(place)
                starter.listen()
                _keep_within(memory, running)
                for process in [process for process in running if process.ended()]:
                    running.remove(process)
                    ended.add(process.place)
                    answers[process.place] = process.answer()
                    if finished is not None:
                        with held.released():
                            finished(process.place, answers[process.place])
                held.let_through()
        finally:
            starter.end()
    return answers


def _keep_within(memory: float, running: Sequence[_Process]) -> None:
    """End the largest process where all together have more than so many bytes."""
    if sum(process.bytes for process in running) > memory:
        max(running, key=lambda process: process.bytes).end_for_memory()


def _ready(tasks: Sequence[Task], waiting: list[int], ended: set[int | None]) -> list[int]:
    """List the tasks that wait for no other."""
    return [place for place in waiting if tasks[place].after in ended]


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


class _Starter:
    """The process that starts those of the tasks, and what it says of them."""

    def __init__(self, tasks: Sequence[Task], folder: Path, packages: Path | None) -> None:
        modules = {str(getattr(task.function, "__module__", "")) for task in tasks}
        own = sorted(name for name in modules if name.startswith("mbds_xsim."))
        threads = {key: "1" for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        # A toolkit for windows takes as long as MuJoCo itself; numba colours what it throws away.
        plain = {"MUJOCO_GL": "disable", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
        first = {} if packages is None else {"PYTHONPATH": _before(packages)}
        # Arrays of megabytes come and go; memory that the system gives anew each time costs more
        # than what most checks do with it.
        memory = f"glibc.malloc.mmap_threshold={_KEPT}:glibc.malloc.trim_threshold={4 * _KEPT}"
        self.folder, self.log = folder, folder / "starter.log"
        with self.log.open("wb") as log:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "mbds_xsim.base.worker", *own],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env={"GLIBC_TUNABLES": memory} | plain | os.environ | threads | first,
                cwd=folder,  # engines drop log files where they stand
                bufsize=0,
            )
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        self._orders, self._words, self._read = self._popen.stdin, self._popen.stdout, b""
        os.set_blocking(self._words.fileno(), False)
        self._news = select.poll()
        self._news.register(self._words, select.POLLIN)
        self.number = self._popen.pid
        self.processes: dict[int, int] = {}
        """Numbers of processes by the places of their tasks."""
        self.codes: dict[int, int] = {}
        """How they ended: exit codes, or minus the number of a signal."""
        self.over = False
        """Whether it has ended itself, and all that it started."""

    def order(self, order: Literal["start", "kill"], place: int) -> None:
        with suppress(BrokenPipeError):  # `listen` will notice
            self._orders.write(f"{order} {place}\n".encode())

    def listen(self) -> None:
        """Take in what it has said since, or says within a moment."""
        words = None
        self._news.poll(_POLL_MS)
        while not self.over and (words := self._words.read(4096)):
            *lines, self._read = (self._read + words).split(b"\n")
            for line in lines:
                what, place, number = line.decode().split()
                (self.processes if what == "began" else self.codes)[int(place)] = int(number)
        self.over = self.over or words is not None

    def end(self, *, at_once: bool = False) -> None:
        """Let it end, and all that it started."""
        self.over = True
        if at_once:
            self._popen.kill()
        self._orders.close()
        self._words.close()
        self._popen.wait()


class _Process:
    """One task under way."""

    def __init__(self, place: int, task: Task, starter: _Starter) -> None:
        self.place = place
        self._task, self._starter = task, starter
        self._file = starter.folder / str(place)
        self._begun = self._file.with_suffix(".begun")
        question = pickle.dumps((task.function, task.arguments))
        self._file.with_suffix(".task").write_bytes(question)
        starter.order("start", place)
        self._spent, self._number = Spent(starter.number), 0
        self._limit, self._since = _START_UP, 0
        self._timed_out, self._took = False, 0

    def ended(self) -> bool:
        if self.place in self._starter.codes or self._starter.over:
            return True
        if not self._number and self.place in self._starter.processes:
            self._number = self._starter.processes[self.place]
            self._spent = Spent(self._number)
        if self._spent.look():
            if self._begun.exists() and (since := self._begun.stat().st_mtime_ns) != self._since:
                self._limit, self._since = self._task.timeout, since
                self._spent.seconds = 0.0
            if self._spent.seconds > self._limit:
                self._timed_out = True
                self.kill()
        return False

    @property
    def bytes(self) -> int:
        """Memory that it has."""
        return self._spent.bytes if self._number else 0

    def end_for_memory(self) -> None:
        self._took = self.bytes
        self.kill()

    def kill(self) -> None:
        if self._number:
            self._starter.order("kill", self.place)
        else:
            self._starter.end(at_once=True)

    def answer(self) -> Any:
        path = self._file.with_suffix(".answer")
        if not path.exists():
            return Crash(self._last_words(), timed_out=self._timed_out)
        try:
            kind, value = pickle.loads(path.read_bytes())
        except Exception as error:  # it may hold what only that process could make
            return Crash(f"its answer cannot be read: {type(error).__name__}: {error}")
        return value if kind == "done" else Crash(in_utf8(value), refused=kind == "input error")

    def _last_words(self) -> str:
        if self._timed_out:
            return f"no answer within {self._limit:g} s" + ("" if self._since else " of starting")
        if self._took:
            return (
                f"it had taken {self._took / 2**30:.3g} GiB when the memory ran out; fewer "
                "--workers leave more to each"
            )
        code = self._starter.codes.get(self.place)
        if code is None:
            return f"the process that starts tasks ended: {_tail(self._starter.log)}"
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"the process crashed with {name}: {_tail(self._file.with_suffix('.log'))}"


def _before(packages: Path) -> str:
    """Give the places in which Python looks for packages, with one before all others."""
    return os.pathsep.join(filter(None, (str(packages.absolute()), os.environ.get("PYTHONPATH"))))


def _tail(log: Path) -> str:
    tail = log.read_text(errors="replace").strip()[-_TAIL:] if log.exists() else ""
    return tail.splitlines()[-1] if tail else "without a word"


class Meter(Protocol):
    """Where work reports its progress."""

    def begin(self, total: int) -> None:
        """Say how many tasks there are."""

    def advance(self, what: str) -> None:
        """Count one task as done."""

    def doing(self, what: str) -> None:
        """Say what is being done now."""

    def notice(self, line: str) -> None:
        """Say what is to stay and be read."""

    def forecast(self, left_s: float) -> None:
        """Say how much work is left [s of one worker]."""


class Silent:
    """Progress sink that discards everything."""

    def begin(self, total: int, done: int = 0) -> None:
        """Discard how much there is."""

    def advance(self, what: str) -> None:
        """Discard what is done."""

    def made(self, done: int, rejected: int) -> None:
        """Discard how many trajectories there are."""

    def doing(self, what: str) -> None:
        """Discard what is under way."""

    def notice(self, line: str) -> None:
        """Discard what was to be read."""

    def forecast(self, left_s: float) -> None:
        """Discard how long it will take."""


@dataclass(frozen=True)
class Conduct:
    """How work is carried out, which decides none of its figures."""

    workers: int | None = None
    """Processes at a time; all cores when None, none but this one for 0."""
    cache: bool = True
    """Whether stored solutions may be used, and are kept."""
    fresh: bool = False
    """Whether what was measured earlier is measured again."""
    meter: Meter = field(default_factory=Silent)

    @property
    def processes(self) -> int:
        """Processes at a time."""
        return core_count() if self.workers is None else self.workers


USUAL = Conduct()
HERE = Conduct(workers=0)
"""In this process alone."""
