"""Cases, and the runner that turns them into rows: kept ones from disk, the others isolated.

A study plans cases and reads rows. What lies between is the same for all and done here: what was
measured earlier is taken from the store; the rest runs side by side in fresh processes with a time
limit; a crash becomes a row like any other; every row is kept as soon as it is there, so that a
study that was interrupted goes on where it stopped. In outline:

    class Row(Keyed, frozen=True, kw_only=True): engine: str; error_m: float | None = None

    def error(scene, start, settings): ...  # runs in its process; gives {"error_m": 0.01}

    runner = Runner(Store.of("my-study", scene.name, Row), crashed=lambda row, crash: row)
    row = Row(key=row_key(...), engine=name)
    rows = runner.rows([StudyCase(row, name, error, lambda: (scene, start, settings), 30.0)])

`docs/add-a-study.md` has a complete study.

Cases of one `group` follow each other in one process, which spares most of its start. What is left
of them when that process crashes, hangs, or has used up half of its time is run once more, each
case by itself: so nothing that goes wrong in one touches another.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol

import msgspec

from mbds_xsim.base.isolate import Crash, Silent, Task, run_tasks
from mbds_xsim.measure.store import R, Store

Arguments = tuple[Any, ...]
Figures = Mapping[str, Any]
"""Fields of a row that were measured, by name."""
Answer = tuple[Figures, float]
"""Figures of a case, and the time that it took [s]."""

_GUESS = 0.5  # time of a case before any is measured [s]
_START = 0.3  # share of a process's start in a case's time [s]


class Meter(Protocol):
    """Where a study reports its progress."""

    def forecast(self, left_s: float) -> None:
        """Say how much work is left [s of one worker]."""

    def advance(self, what: str) -> None:
        """Count one case as measured."""


@dataclass(frozen=True, eq=False)
class StudyCase(Generic[R]):
    """One piece of work, named by its content."""

    row: R
    """Its row without figures; the key stands for all that decides these."""
    name: str
    """For people who watch the progress."""
    function: Callable[..., Figures]
    """Function of a module that measures, and gives fields of the row."""
    arguments: Callable[[], Arguments]
    """Gives its arguments, picklable; asked only where the case has to be run."""
    limit: float
    """Longest that it may take [s]."""
    group: Hashable = None
    """Cases of equal groups share a process; None: it has one of its own."""
    pace: Hashable = None
    """Cases of equal pace take about as long."""


def always(kept: Any, row: Any) -> bool:
    """Trust any row that was kept."""
    del kept, row
    return True


def in_time(kept: Any, row: Any) -> bool:
    """Trust a row that was kept unless it ran out of less time than is given now."""
    return not kept.unmeasured or kept.limit_s >= row.limit_s


@dataclass
class Runner(Generic[R]):
    """Gives the rows of cases; see the module."""

    store: Store[R]
    crashed: Callable[[R, Crash], R]
    """Makes the row of a case whose process gave no answer."""
    labels: Sequence[str] = ()
    """Fields that do not decide figures: a kept row has them from the case that asks for it."""
    lasts: Callable[[R, R], bool] = always
    """Whether a kept row (the first argument) need not be measured again for a case's row."""
    workers: int | None = None
    """Processes at a time; all cores when None, none but this one for 0."""
    fresh: bool = False
    """Whether rows that were kept earlier are measured again."""
    meter: Meter = field(default_factory=Silent)
    forecasts: bool = True
    """Whether the runner predicts the time that is left, by the cases that are done."""
    measured: int = 0
    """Rows measured by this runner."""
    kept: int = 0
    """Rows taken from the store."""
    _now: dict[str, R] = field(default_factory=dict)
    _seconds: dict[Hashable, list[float]] = field(default_factory=lambda: defaultdict(list))

    def rows(self, cases: Sequence[StudyCase[R]]) -> list[R]:
        """Give the row of each case, measuring those that are missing."""
        missing = self.missing(cases)
        groups: dict[Hashable, list[StudyCase[R]]] = {}
        for case in missing:
            groups.setdefault(case.row.key if case.group is None else case.group, []).append(case)
        self._run(list(groups.values()), missing, last=False)
        self._run([[case] for case in self.missing(missing)], missing, last=True)
        return [self._labelled(self._now[case.row.key], case) for case in cases]

    def missing(self, cases: Sequence[StudyCase[R]]) -> list[StudyCase[R]]:
        """List the cases that have to be measured, each key once; the others' rows are taken."""
        for case in cases:
            kept = None if self.fresh else self.store.rows.get(case.row.key)
            if case.row.key not in self._now and kept and self.lasts(kept, case.row):
                self._now[case.row.key] = kept
                self.kept += 1
        found = {case.row.key: case for case in cases if case.row.key not in self._now}
        return list(found.values())

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
        run_tasks([_task(group) for group in groups], workers=self.workers, finished=finished)

    def _keep(self, case: StudyCase[R], row: R, seconds: float) -> None:
        self._now[row.key] = row
        self.store.add(row)
        self.measured += 1
        self._seconds[case.pace].append(_START + seconds)
        self.meter.advance(case.name)

    def _forecast(self, cases: Sequence[StudyCase[R]]) -> None:
        if self.forecasts:
            left = Counter(case.pace for case in cases if case.row.key not in self._now)
            self.meter.forecast(sum(n * self._expected(pace) for pace, n in left.items()))

    def _expected(self, pace: Hashable) -> float:
        """Time of a case of a pace: as those that had it, else as all [s]."""
        alike = self._seconds.get(pace) or list(itertools.chain(*self._seconds.values()))
        return statistics.fmean(alike) if alike else _GUESS

    def _labelled(self, row: R, case: StudyCase[R]) -> R:
        today = {name: getattr(case.row, name) for name in self.labels}
        return msgspec.structs.replace(row, **today)


def _task(group: Sequence[StudyCase[Any]]) -> Task:
    first = group[0]
    arguments = [case.arguments() for case in group]
    return Task(in_turn, (first.function, arguments, first.limit / 2.0), first.limit)


def in_turn(
    function: Callable[..., Figures], arguments: Sequence[Arguments], patience: float
) -> list[Answer]:
    """Call a function with one after the other, as many as are begun within a time [s].

    It is the processor's time; half of a process's limit is left to the last that is begun.
    """
    first = time.process_time()
    answers: list[Answer] = []
    for each in arguments:
        if answers and time.process_time() - first > patience:
            break
        begin = time.perf_counter()
        answers.append((function(*each), time.perf_counter() - begin))
    return answers
