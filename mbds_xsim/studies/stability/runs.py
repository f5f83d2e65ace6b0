"""The runs of a study: kept ones are taken from disk, the others run in processes of their own.

The steps of one engine's method at one value follow each other in one process, as all values of one
trained model do, which spares most of its start. What is left of them when the process crashes,
hangs, or has used up its time, is run once more, each in a process by itself: so nothing that goes
wrong in a cell touches another one.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.measure.identity import machine
from mbds_xsim.measure.store import Store
from mbds_xsim.reference.cache import directory
from mbds_xsim.studies.stability.contenders import Job, Plan
from mbds_xsim.studies.stability.definition import Value, text_of
from mbds_xsim.studies.stability.rows import Cell
from mbds_xsim.studies.stability.verdict import Judged
from mbds_xsim.studies.tradeoff.bench import Meter

_GUESS = 0.5  # time of a cell before any is measured [s]
_START = 0.3  # share of a process's start, and of judging, in a cell's time [s]


class Measuring:
    """Gives the cells of jobs; every one is kept as soon as it is there."""

    def __init__(self, plan: Plan, meter: Meter) -> None:
        self._plan = plan
        self._meter = meter
        self._store = Store(directory() / "stability" / f"{plan.study.name}.jsonl", Cell)
        self._seconds: dict[int, list[float]] = defaultdict(list)
        self.cells: dict[str, Cell] = {}
        """By the keys of jobs."""
        self.kept = 0
        """Cells that came from an earlier run."""

    def run(self, jobs: Sequence[Job]) -> None:
        """Fill `cells` for all jobs."""
        for job in jobs:
            cell = None if self._plan.fresh else self._store.rows.get(job.key)
            if cell is not None and self._lasts(cell):
                self.cells[job.key] = msgspec.structs.replace(
                    cell, value=job.case.value, source=job.contender.source
                )
        self.kept = len(self.cells)
        self._run_groups(_rows(self._missing(jobs)), alone=False)
        self._run_groups([[job] for job in self._missing(jobs)], alone=True)

    def _missing(self, jobs: Sequence[Job]) -> list[Job]:
        return [job for job in jobs if job.key not in self.cells]

    def _lasts(self, cell: Cell) -> bool:
        """Whether a kept cell need not be run again: a crash may have come from outside."""
        if cell.outcome == "timed out":
            return cell.limit_s >= self._plan.limit
        return cell.outcome != "crashed"

    def _run_groups(self, groups: list[list[Job]], *, alone: bool) -> None:
        def finished(place: int, answer: list[Judged] | Crash) -> None:
            group = groups[place]
            if isinstance(answer, Crash) and not alone and len(group) > 1:
                return
            answers: Sequence[Judged | Crash] = [answer] if isinstance(answer, Crash) else answer
            for job, judged in zip(group, answers, strict=False):
                self._keep(job, judged)
            self._forecast([job for group in groups for job in group])

        self._forecast([job for group in groups for job in group])
        run_tasks(list(map(self._task, groups)), workers=self._plan.workers, finished=finished)

    def _task(self, group: list[Job]) -> Task:
        cells = [(job.case, job.count) for job in group]
        return group[0].contender.task(cells, self._plan.limit)

    def _keep(self, job: Job, answer: Judged | Crash) -> None:
        cell = _cell(self._plan, job, answer)
        self.cells[job.key] = cell
        self._store.add(cell)
        self._seconds[job.count].append(_START + (cell.wall_s or self._plan.limit))
        self._meter.advance(f"{job.contender.name}, {text_of(cell.value, self._plan.study.unit)}")

    def _forecast(self, jobs: Sequence[Job]) -> None:
        self._meter.forecast(math.fsum(self._expected(job.count) for job in self._missing(jobs)))

    def _expected(self, count: int) -> float:
        """Time of a cell by its steps a frame: as those that took as many, else as all [s]."""
        all_times = [s for times in self._seconds.values() for s in times]
        alike = self._seconds.get(count) or all_times
        return statistics.fmean(alike) if alike else _GUESS


def _rows(jobs: Sequence[Job]) -> list[list[Job]]:
    """Put what may share a process together; those of most bodies first, who last."""
    rows: dict[tuple[Value, ...], list[Job]] = defaultdict(list)
    for job in jobs:
        rows[job.contender.group(job.case.value)].append(job)
    return sorted(rows.values(), key=lambda row: -len(row[0].case.scene.bodies))


def _cell(plan: Plan, job: Job, answer: Judged | Crash) -> Cell:
    who, scene = job.contender, job.case.scene
    bare = Cell(
        key=job.key,
        study=plan.study.name,
        value=job.case.value,
        engine=who.engine,
        version=who.version,
        method=who.method,
        family=who.family,
        profile=who.profile,
        options=who.options(scene),
        step_s=scene.clock.frame / job.count,
        duration_s=scene.clock.duration,
        limit_s=plan.limit,
        machine=machine(),
        outcome="crashed",
        told="process",
        source=who.source,
    )
    if isinstance(answer, Crash):
        outcome = "refused" if answer.refused else "timed out" if answer.timed_out else "crashed"
        reason = " ".join(answer.reason.split())
        return msgspec.structs.replace(bare, outcome=outcome, reason=reason)
    figures = {key: _plain(value) for key, value in vars(answer.verdict).items()}
    return msgspec.structs.replace(bare, wall_s=answer.wall_s, **figures)


def _plain(value: Any) -> Any:
    """Keep what JSON can hold."""
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
