"""Run tasks side by side, each in a fresh process of its own.

An engine may crash its process, hang, or keep settings that outlive a disconnect: none of that
may affect another result. The processes are forks of one that has imported no engine, since engines
do not survive a fork. `multiprocessing` is not used: it would import the user's script again in
each process, which breaks a script without a main guard.
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

from mbds_xsim.base.process import Interruptions, Usage, absolute_folders, memory_bytes
from mbds_xsim.base.text import in_utf8

LIMIT = 3600.0
"""Default time limit of one task [s]."""

_POLL_MS = 10  # longest wait for a report of the starter
_START_UP = 600.0  # time limit for a task's imports [s]
_SHARE = 0.8  # of the machine's memory, for all processes together
_REUSE = 2**29  # largest array whose memory is reused [bytes]
_TAIL = 400  # characters read from the end of a log


@dataclass(frozen=True)
class Task:
    """A picklable module-level function with its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    timeout: float = LIMIT
    """Time limit [s]; starting the process and waiting for busy cores do not count."""
    after: int | None = None
    """Index, in the list of tasks, of a task that must end before this one starts."""


@dataclass(frozen=True)
class Crash:
    """Record of a task that ended without an answer."""

    reason: str
    refused: bool = False
    """Whether the task raised an `InputError`, whose text is the reason."""
    timed_out: bool = field(default=False, compare=False)
    """Whether the task was ended at its time limit."""

    @property
    def kind(self) -> Literal["refused", "timed out", "crashed"]:
        """Way in which the task ended."""
        return "refused" if self.refused else "timed out" if self.timed_out else "crashed"


def begin(path: Path | None = None) -> None:
    """Report that the actual work of this process's task begins now, and restart its clock.

    The worker calls this once the imports of a task are done. A task may call it again after it has
    loaded an engine, or before its next part. Outside a worker it does nothing.

    Args:
        path: File that is touched as the report, now and in later calls.
    """
    global _begun
    _begun = path or _begun
    if _begun is not None:
        _begun.touch()


def in_worker() -> bool:
    """Return whether this process carries out a task of another process."""
    return _begun is not None


_begun: Path | None = None


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Carrier(Protocol):
    """Function that carries out tasks: `run_tasks`, or one that sends them to a cluster."""

    def __call__(
        self,
        tasks: Sequence[Task],
        *,
        workers: int | None = None,
        finished: Callable[[int, Any], None] | None = None,
    ) -> list[Any]:
        """Return one answer or `Crash` for each task, in the order of the tasks."""


def run_tasks(
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    started: Callable[[int], None] | None = None,
    finished: Callable[[int, Any], None] | None = None,
    packages: Path | None = None,
) -> list[Any]:
    """Carry out all tasks, starting them in the order of the list as workers become free.

    Args:
        tasks: Tasks, the longest first, but each one before those that wait for it.
        workers: Number of processes at a time; one per core by default. 0 runs the tasks in this
            process, one after the other, for debuggers and for tests that change what a task does:
            there is no timeout then, and an error is raised where it happens.
        started: Called with the index of a task when its process begins.
        finished: Called with the index and answer of each task when it ends. The next process
            starts only after it returns, so that no more processes work than were asked for.
        packages: Folder of packages that the processes import in preference to all others.

    Returns:
        One answer or `Crash` for each task, in the order of the tasks.
    """
    if workers is not None and workers < 0:
        raise ValueError(f"workers: got {workers}, allowed is 0 or more; one per core if left out")
    if workers == 0:
        return [_run_here(place, task, started, finished) for place, task in enumerate(tasks)]
    answers: list[Any] = [None] * len(tasks)
    if not tasks:
        return answers
    waiting, ended, running = list(range(len(tasks))), set[int | None]({None}), list[_Process]()
    with (
        Interruptions() as interruptions,
        tempfile.TemporaryDirectory(prefix="mbds-xsim-") as folder,
    ):
        starter = _Starter(tasks, Path(folder), packages)
        most = min(workers or core_count(), len(tasks))
        memory = _SHARE * memory_bytes()
        try:
            while waiting or running:
                while len(running) < most and (ready := _ready(tasks, waiting, ended)):
                    waiting.remove(place := ready[0])
                    if starter.over:  # it was killed
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
                        with interruptions.released():
                            finished(process.place, answers[process.place])
                interruptions.let_through()
        finally:
            starter.end()
    return answers


def _keep_within(memory: float, running: Sequence[_Process]) -> None:
    """End the largest process if all together use more than `memory` bytes."""
    if sum(process.bytes for process in running) > memory:
        max(running, key=lambda process: process.bytes).end_for_memory()


def _ready(tasks: Sequence[Task], waiting: list[int], ended: set[int | None]) -> list[int]:
    """List the waiting tasks that may start: they follow no task, or one that has ended."""
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
    """The process that starts the task processes, and its reports about them."""

    def __init__(self, tasks: Sequence[Task], folder: Path, packages: Path | None) -> None:
        modules = {str(getattr(task.function, "__module__", "")) for task in tasks}
        own = sorted(name for name in modules if name.startswith("mbds_xsim."))
        threads = {key: "1" for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        # Importing a window toolkit takes as long as MuJoCo; numba colours messages it discards.
        plain = {"MUJOCO_GL": "disable", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
        # The process works in another folder, where files of tasks that are ended vanish, too.
        folders = absolute_folders(packages) | {"TMPDIR": str(folder)}
        # Arrays of megabytes come and go; to get their memory from the system each time would cost
        # more time than most checks spend on them.
        memory = f"glibc.malloc.mmap_threshold={_REUSE}:glibc.malloc.trim_threshold={4 * _REUSE}"
        self.folder, self.log = folder, folder / "starter.log"
        with self.log.open("wb") as log:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "mbds_xsim.base.worker", *own],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env={"GLIBC_TUNABLES": memory} | plain | os.environ | threads | folders,
                cwd=folder,  # engines write log files into the current folder
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
        """Process ids, keyed by the index of the task."""
        self.codes: dict[int, int] = {}
        """Exit codes, or minus the number of a signal, keyed by the index of the task."""
        self.over = False
        """Whether the starter and all processes that it started have ended."""

    def order(self, order: Literal["start", "kill"], place: int) -> None:
        with suppress(BrokenPipeError):  # `listen` will notice
            self._orders.write(f"{order} {place}\n".encode())

    def listen(self) -> None:
        """Read the starter's new reports, waiting a moment for one."""
        words = None
        self._news.poll(_POLL_MS)
        while not self.over and (words := self._words.read(4096)):
            *lines, self._read = (self._read + words).split(b"\n")
            for line in lines:
                event, place, number = line.decode().split()
                (self.processes if event == "began" else self.codes)[int(place)] = int(number)
        self.over = self.over or words is not None

    def end(self, *, at_once: bool = False) -> None:
        """End the starter and all processes that it started."""
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
        self._file.with_suffix(".task").write_bytes(pickle.dumps((task.function, task.arguments)))
        starter.order("start", place)
        self._usage, self._number = Usage(starter.number), 0
        self._limit, self._since = _START_UP, 0
        self._timed_out, self._took = False, 0

    def ended(self) -> bool:
        if self.place in self._starter.codes or self._starter.over:
            return True
        if not self._number and self.place in self._starter.processes:
            self._number = self._starter.processes[self.place]
            self._usage = Usage(self._number)
        if self._usage.look():
            if self._begun.exists() and (since := self._begun.stat().st_mtime_ns) != self._since:
                self._limit, self._since = self._task.timeout, since
                self._usage.seconds = 0.0
            if self._usage.seconds > self._limit:
                self._timed_out = True
                self.kill()
        return False

    @property
    def bytes(self) -> int:
        """Resident memory of the process [bytes]; 0 before it has begun."""
        return self._usage.bytes if self._number else 0

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
        except Exception as error:  # it may hold objects only that process can make
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


def _tail(log: Path) -> str:
    tail = log.read_text(errors="replace").strip()[-_TAIL:] if log.exists() else ""
    return tail.splitlines()[-1] if tail else "without a word"


class Meter(Protocol):
    """Receiver of progress reports."""

    def begin(self, total: int) -> None:
        """Report the number of tasks."""

    def advance(self, work: str) -> None:
        """Count one task as done."""

    def doing(self, work: str) -> None:
        """Report the current activity."""

    def notice(self, line: str) -> None:
        """Show a line that is to stay visible."""

    def forecast(self, left_s: float) -> None:
        """Report the remaining work [s of one worker]."""


class Silent:
    """Progress sink that discards everything."""

    def begin(self, total: int, done: int = 0) -> None:
        """Discard the number of tasks."""

    def advance(self, work: str) -> None:
        """Discard a finished task."""

    def made(self, done: int, rejected: int) -> None:
        """Discard the numbers of trajectories."""

    def doing(self, work: str) -> None:
        """Discard the current activity."""

    def notice(self, line: str) -> None:
        """Discard a line."""

    def forecast(self, left_s: float) -> None:
        """Discard the remaining work."""


@dataclass(frozen=True)
class Conduct:
    """Options of how work is carried out; none of them changes a result."""

    workers: int | None = None
    """Number of processes at a time; one per core if None, only this process if 0."""
    cache: bool = True
    """Whether stored solutions may be used, and new ones are stored."""
    fresh: bool = False
    """Whether earlier measurements and installations are repeated."""
    meter: Meter = field(default_factory=Silent)

    @property
    def processes(self) -> int:
        """Number of processes at a time."""
        return core_count() if self.workers is None else self.workers


USUAL = Conduct()
HERE = Conduct(workers=0)
"""Options for work in this process alone."""
