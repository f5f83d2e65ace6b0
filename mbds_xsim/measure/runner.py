"""Cases, and the runner that turns them into rows: stored ones from disk, others isolated.

A study plans cases and reads rows. The runner does the rest: rows measured earlier are taken from
the store; the other cases run in parallel in fresh processes with a time limit; a crash becomes a
row like any other; every row is stored at once, so that an interrupted study resumes where it
stopped. In outline:

    class Row(Keyed, frozen=True, kw_only=True): engine: str; error_m: float | None = None
    def error(scene, start, settings): ...  # runs in its process; returns {"error_m": 0.01}

    runner = Runner(Store.of("my-study", scene.name, Row), crashed=lambda row, crash: row)
    row = Row(key=row_key(...), engine=name)
    rows = runner.rows([StudyCase(row, name, error, lambda: (scene, start, settings), 30.0)])

`docs/add-a-study.md` has a complete study. Cases of one `group` follow each other in one process,
which saves most of its start. Cases left over when that process crashes, hangs, or has used up half
of its time run once more, each in its own process, so that no failure affects another case.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import os
import platform
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import USUAL, Conduct, Crash, Meter, Task, run_tasks
from mbds_xsim.base.text import counted
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.reference.cache import directory, key_of
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.simulator import Simulator

Arguments = tuple[Any, ...]
Figures = Mapping[str, Any]
"""Measured fields of a row, by name."""
Answer = tuple[Figures, float]
"""Figures of a case, and its time [s]."""

_GUESS = 0.5  # expected time of a case before any is measured [s]
_START = 0.3  # share of a process's start in a case's time [s]
Account = defaultdict[str, float]
"""Elapsed time of all processes together [s], by purpose."""
PROCESSES = "processes"
"""Purpose of time for starting processes, importing engines, passing tasks and answers."""


class Keyed(msgspec.Struct, frozen=True, kw_only=True):
    """A row that can be stored."""

    key: str
    """Hash of everything that decides the figures."""


R = TypeVar("R", bound=Keyed)


class Store(Generic[R]):
    """Rows of one kind by key, on disk; the latest row of a key counts."""

    def __init__(self, path: Path, kind: type[R]) -> None:
        self.path = path
        self.rows: dict[str, R] = {row.key: row for row in _read(path, kind)}

    @classmethod
    def of(cls, study: str, subject: str, kind: type[R]) -> Store[R]:
        """Open the store of a study's rows about a subject in the user's cache directory."""
        safe = "".join(c if c.isalnum() or c in "-_." else "_" for c in subject)
        return cls(directory() / study / f"{safe}.jsonl", kind)

    def add(self, row: R) -> None:
        """Store a row.

        Raises:
            InputError: The row cannot be written.
        """
        self.rows[row.key] = row
        # Start on a new line even after one that was cut off.
        row_text = msgspec.json.encode(row)
        line = b"\n" + _sum(row_text) + b" " + row_text + b"\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab", buffering=0) as file:
                file.write(line)  # one call, so that rows of several processes do not mix
        except OSError as error:
            msg = f"cannot keep rows in {self.path}: {error.strerror}; set MBDS_XSIM_CACHE"
            raise InputError(msg) from error


def _read(path: Path, kind: type[R]) -> Iterator[R]:
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        checksum, _, text = line.partition(b" ")
        if checksum == _sum(text):
            with contextlib.suppress(msgspec.DecodeError):
                yield msgspec.json.decode(text, type=kind)


def _sum(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:16].encode()


def row_key(
    scene: Scene, start: Batch, simulator: Simulator, count: int, *more: str | float
) -> str:
    """Return a key made from a row's content.

    It covers the physics, the start and its inputs, the budgets, the simulator at a number of
    steps per frame, the versions of all that runs and judges it, and the machine; `more` are the
    study's own constants.
    """
    content = [
        key_of("tradeoff", scene, start, 0, 0.0),
        scene.budget,
        *simulator.decisive(scene, count),
        CHECKS,
        registry.package_version("numpy"),
        machine(),
        *more,
    ]
    return hashlib.sha256(msgspec.json.encode(content, enc_hook=float)).hexdigest()


def versions_of(packages: Mapping[str, str]) -> dict[str, str]:
    """Return the versions behind a result: of this toolkit, and of the packages that ran."""
    own = {name: registry.package_version(name) for name in ("mbds-xsim", "numpy", "scipy")}
    return own | {"python": platform.python_version()} | dict(packages)


@functools.cache
def machine() -> str:
    """Return the processor, cores and system of this machine."""
    cores = counted(os.cpu_count(), "core")
    return f"{_processor()}, {cores}, {platform.system()} {platform.machine()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown processor"


@dataclass(frozen=True, eq=False)
class StudyCase(Generic[R]):
    """One piece of work, identified by its content."""

    row: R
    """Row without figures; its key stands for everything that decides them."""
    name: str
    """Name shown in progress reports."""
    function: Callable[..., Figures]
    """Module-level function that measures, and returns fields of the row."""
    arguments: Callable[[], Arguments]
    """Function that returns its arguments, picklable; called only if the case has to run."""
    limit: float
    """Time limit [s]."""
    group: Hashable = None
    """Group of cases that share a process; None for a process of its own."""
    pace: Hashable = None
    """Key of cases that take about equally long."""


def always(stored: Any, row: Any) -> bool:
    """Trust any stored row."""
    del stored, row
    return True


def in_time(stored: Any, row: Any) -> bool:
    """Trust a stored row unless it is unmeasured and had less time than is allowed now."""
    return not stored.unmeasured or stored.limit_s >= row.limit_s


@dataclass
class Runner(Generic[R]):
    """Runner that turns cases into rows; see the module."""

    store: Store[R]
    crashed: Callable[[R, Crash], R]
    """Function that makes the row of a case whose process gave no answer."""
    labels: Sequence[str] = ()
    """Fields that do not decide figures; a stored row takes them from the requesting case."""
    lasts: Callable[[R, R], bool] = always
    """Function that returns whether a stored row (the first argument) serves for a case's row."""
    conduct: Conduct = USUAL
    forecasts: bool = True
    """Whether it predicts the remaining time from the finished cases."""
    packages: Path | None = None
    """Folder whose packages the processes use instead of this process's."""
    measured: int = 0
    """Number of rows measured by this runner."""
    reused: int = 0
    """Number of rows taken from the store."""
    _now: dict[str, R] = field(default_factory=dict)
    _seconds: dict[Hashable, list[float]] = field(default_factory=lambda: defaultdict(list))

    def rows(self, cases: Sequence[StudyCase[R]]) -> list[R]:
        """Return the row of each case, measuring those that are missing."""
        missing = self.missing(cases)
        groups: dict[Hashable, list[StudyCase[R]]] = {}
        for case in missing:
            groups.setdefault(case.row.key if case.group is None else case.group, []).append(case)
        self._run(list(groups.values()), missing, last=False)
        self._run([[case] for case in self.missing(missing)], missing, last=True)
        return [self._labelled(self._now[case.row.key], case) for case in cases]

    def missing(self, cases: Sequence[StudyCase[R]]) -> list[StudyCase[R]]:
        """List the cases to be measured, each key once; take the others' rows from the store."""
        for case in cases:
            stored = None if self.conduct.fresh else self.store.rows.get(case.row.key)
            if case.row.key not in self._now and stored and self.lasts(stored, case.row):
                self._now[case.row.key] = stored
                self.reused += 1
        missing = {case.row.key: case for case in cases if case.row.key not in self._now}
        return list(missing.values())

    def _run(
        self, groups: list[list[StudyCase[R]]], cases: Sequence[StudyCase[R]], *, last: bool
    ) -> None:
        def finished(place: int, answer: list[Answer] | Crash) -> None:
            group = groups[place]
            if isinstance(answer, Crash):
                if last or len(group) == 1:
                    self._keep(group[0], self.crashed(group[0].row, answer), group[0].limit)
            else:
                for case, (figures, seconds) in zip(group, answer, strict=False):
                    self._keep(case, msgspec.structs.replace(case.row, **figures), seconds)
            self._forecast(cases)

        self._forecast(cases)
        tasks = [_task(group) for group in groups]
        run_tasks(tasks, workers=self.conduct.workers, finished=finished, packages=self.packages)

    def _keep(self, case: StudyCase[R], row: R, seconds: float) -> None:
        self._now[row.key] = row
        self.store.add(row)
        self.measured += 1
        self._seconds[case.pace].append(_START + seconds)
        self.conduct.meter.advance(case.name)

    def _forecast(self, cases: Sequence[StudyCase[R]]) -> None:
        if self.forecasts:
            counts = Counter(case.pace for case in cases if case.row.key not in self._now)
            self.conduct.meter.forecast(sum(n * self._expected(pace) for pace, n in counts.items()))

    def _expected(self, pace: Hashable) -> float:
        """Return the mean time of cases of a pace or, without any, of all cases [s]."""
        seconds = self._seconds.get(pace) or list(itertools.chain(*self._seconds.values()))
        return statistics.fmean(seconds) if seconds else _GUESS

    def _labelled(self, row: R, case: StudyCase[R]) -> R:
        labels = {name: getattr(case.row, name) for name in self.labels}
        return msgspec.structs.replace(row, **labels)


def _task(group: Sequence[StudyCase[Any]]) -> Task:
    first = group[0]
    arguments = [case.arguments() for case in group]
    return Task(in_turn, (first.function, arguments, first.limit / 2.0), first.limit)


def in_turn(
    function: Callable[..., Figures], arguments: Sequence[Arguments], patience: float
) -> list[Answer]:
    """Call a function with each set of arguments in turn, starting none after `patience` [s].

    Patience is processor time; the other half of the process's limit is left to the last call.
    """
    first = time.process_time()
    answers: list[Answer] = []
    for each in arguments:
        if answers and time.process_time() - first > patience:
            break
        begin = time.perf_counter()
        answers.append((function(*each), time.perf_counter() - begin))
    return answers


@dataclass(frozen=True)
class Piece:
    """A task, its readable name, and the function that stores its answer."""

    name: str
    of: str
    """Purpose as which its time is counted, such as an engine or the reference."""
    task: Task
    keep: Callable[[Any], None]
    """Function called with the answer once all pieces of the same purpose are done."""


def carry_out(
    pieces: Sequence[Piece],
    conduct: Conduct,
    spent: Account,
    then: Callable[[str], object] = str,
) -> None:
    """Carry out pieces of work in parallel, and store the answers of each engine in order.

    Args:
        pieces: Pieces of work; answers that know their own time have it as `busy_s`.
        conduct: How the work is carried out.
        spent: Elapsed time of all processes by purpose [s], to which these pieces add theirs.
        then: Function called with each purpose once its answers are stored; others may still run.
    """
    running = Running(conduct.meter, [piece.name for piece in pieces])
    begun: dict[int, float] = {}
    answers: dict[int, Any] = {}
    away = 0.0  # time in which this process did not watch the others [s]

    def started(place: int) -> None:
        begun[place] = time.perf_counter() - away
        running.started(place)

    def finished(place: int, answer: Any) -> None:
        nonlocal away
        purpose, now = pieces[place].of, time.perf_counter()
        elapsed = now - away - begun[place]
        own = getattr(answer, "busy_s", elapsed)
        spent[purpose] += own
        spent[PROCESSES] += max(0.0, elapsed - own)
        running.finished(place, answer)
        answers[place] = answer
        alike = [k for k, piece in enumerate(pieces) if piece.of == purpose]
        if answers.keys() >= set(alike):
            for k in alike:
                pieces[k].keep(answers[k])
            then(purpose)
        away += time.perf_counter() - now

    tasks = [piece.task for piece in pieces]
    run_tasks(tasks, workers=conduct.workers, started=started, finished=finished)


@dataclass
class Running:
    """Progress report of the tasks under way, which names the one begun first."""

    meter: Meter
    names: list[str]
    _now: list[int] = field(default_factory=list)

    def started(self, place: int) -> None:
        """Note that a task begins."""
        self._now.append(place)
        self.meter.doing(self._status())

    def finished(self, place: int, _answer: Any) -> None:
        """Note that a task has ended."""
        self._now.remove(place)
        self.meter.advance(self._status() or self.names[place])

    def _status(self) -> str:
        names = list(dict.fromkeys(self.names[place] for place in self._now))
        others = f" and {len(names) - 1} more" if names[1:] else ""
        return names[0] + others if names else ""
