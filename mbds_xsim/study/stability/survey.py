"""A study carried out: every engine, method, value and step, each in a process of its own."""

from __future__ import annotations

import hashlib
import math
import platform
import statistics
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mbds_xsim import reference, registry
from mbds_xsim.engine import Profile, Settings
from mbds_xsim.isolate import Crash, Task, core_count, run_tasks
from mbds_xsim.reference import FirstImpact
from mbds_xsim.reference.cache import directory
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory
from mbds_xsim.study.bench import Meter
from mbds_xsim.study.identity import machine, row_key
from mbds_xsim.study.stability.cell import Judged, run_cell
from mbds_xsim.study.stability.contenders import Contender, contenders_of
from mbds_xsim.study.stability.definition import COUNTS, FRAME, Study, Value, text_of
from mbds_xsim.study.stability.rows import SCHEMA, Cell, Panel, Sweep
from mbds_xsim.study.stability.verdict import CRITERIA
from mbds_xsim.study.store import Store

__all__ = ["LIMIT", "Plan", "Silent", "survey"]

LIMIT = 30.0
"""Longest that a cell may take [s]."""

_REFERENCE_LIMIT = 120.0  # [s]
_GUESS = 2.0  # time of a cell before any is measured [s]


class Silent:
    """Takes the progress that nobody wants to see."""

    def forecast(self, left_s: float) -> None:
        """Take how much work is left."""

    def advance(self, what: str) -> None:
        """Take that a cell is done."""


@dataclass(frozen=True)
class Plan:
    """What of a study is carried out, and how."""

    study: Study
    engines: tuple[str, ...]
    methods: tuple[str, ...] = ()
    """All of an engine's where none is named."""
    profiles: tuple[Profile, ...] = ("matched", "native")
    values: tuple[Value, ...] = ()
    """The study's where none is given."""
    counts: tuple[int, ...] = COUNTS
    """Steps a frame."""
    limit: float = LIMIT
    """Longest that a cell may take [s]."""
    workers: int | None = None
    """Processes at a time; all cores when None, none but this one for 0."""
    fresh: bool = False
    """Whether cells that were measured earlier are measured again."""
    cache: bool = True
    """Whether reference solutions are kept."""
    command: str = ""


@dataclass(frozen=True)
class _Case:
    """The scene at one value."""

    value: Value
    scene: Scene
    batch: Batch
    truth: Trajectory | None


@dataclass(frozen=True)
class _Job:
    case: _Case
    contender: Contender
    count: int
    key: str

    @property
    def settings(self) -> Settings:
        return self.contender.settings(self.case.scene, self.count)


@dataclass
class _Done:
    """Cells by their keys, and how long those measured in this run took."""

    store: Store[Cell]
    cells: dict[str, Cell] = field(default_factory=dict)
    seconds: dict[int, list[float]] = field(default_factory=lambda: defaultdict(list))
    kept: int = 0


def survey(plan: Plan, meter: Meter | None = None) -> Sweep:
    """Carry out a study; what was measured earlier is taken from the store.

    Raises:
        InputError: No method can do any of the scenes, or settings are not allowed.
    """
    begin = time.perf_counter()
    values = plan.values or plan.study.values
    scenes = {value: plan.study.scene(value) for value in values}
    contenders, left_out = contenders_of(plan, list(scenes.values()))
    truths, unknown = _truths(plan, scenes)
    cases = [
        _Case(value, scene, plan.study.batch(scene), truths.get(value))
        for value, scene in scenes.items()
    ]
    grid = [
        [[_job(case, contender, count) for count in plan.counts] for case in cases]
        for contender in contenders
    ]
    jobs = [job for panel in grid for row in panel for job in row]
    done = _measure(plan, jobs, meter or Silent())
    return Sweep(
        schema=SCHEMA,
        study=plan.study.name,
        sentence=plan.study.sentence,
        quantity=plan.study.quantity,
        unit=plan.study.unit,
        values=tuple(values),
        steps_s=tuple(FRAME / count for count in plan.counts),
        duration_s=FRAME * plan.study.frames,
        criteria=CRITERIA,
        panels=tuple(
            _panel(contender, rows, done) for contender, rows in zip(contenders, grid, strict=True)
        ),
        left_out=left_out,
        unknown=unknown,
        command=plan.command,
        versions=_versions(contender.engine for contender in contenders),
        machine=machine(),
        workers=core_count() if plan.workers is None else plan.workers,
        measured=len(jobs) - done.kept,
        kept=done.kept,
        wall_s=time.perf_counter() - begin,
    )


def _truths(
    plan: Plan, scenes: dict[Value, Scene]
) -> tuple[dict[Value, Trajectory], dict[str, str]]:
    """Solve what has a reference; a value that has none is told, and goes without."""
    if not plan.study.known:
        reason = "rigid contact of several spheres has no unique solution"
        return {}, dict.fromkeys(map(text_of, scenes), reason)
    tasks = [
        Task(_truth, (scene, plan.study.batch(scene), plan.cache), _REFERENCE_LIMIT)
        for scene in scenes.values()
    ]
    answers = run_tasks(tasks, workers=plan.workers)
    found: dict[Value, Trajectory] = {}
    unknown: dict[str, str] = {}
    for value, answer in zip(scenes, answers, strict=True):
        failure = None if isinstance(answer, Crash) else answer.failures[0]
        if isinstance(answer, Crash):
            unknown[text_of(value)] = answer.reason
        elif failure is not None and not isinstance(failure, FirstImpact):
            unknown[text_of(value)] = failure.reason
        else:
            found[value] = answer
    return found, unknown


def _truth(scene: Scene, batch: Batch, cache: bool) -> Trajectory:
    return reference.solve(scene, batch, cache=cache)


def _job(case: _Case, contender: Contender, count: int) -> _Job:
    settings = contender.settings(case.scene, count)
    digest = hashlib.sha256(_judge_source())
    digest.update(row_key(case.scene, case.batch, contender.engine, settings).encode())
    digest.update(repr((case.truth is None, len(case.batch.force[0]))).encode())
    return _Job(case, contender, count, digest.hexdigest())


def _judge_source() -> bytes:
    here = Path(__file__).parent
    return b"".join((here / name).read_bytes() for name in ("verdict.py", "cell.py"))


def _measure(plan: Plan, jobs: Sequence[_Job], meter: Meter) -> _Done:
    """Run what is not kept; the longest first, which leaves no core without work at the end."""
    done = _Done(Store(directory() / "stability" / f"{plan.study.name}.jsonl", Cell))
    for job in jobs:
        cell = None if plan.fresh else done.store.rows.get(job.key)
        if cell is not None and _lasts(cell, plan):
            done.cells[job.key] = msgspec.structs.replace(cell, value=job.case.value)
    done.kept = len(done.cells)
    waiting = [job for job in jobs if job.key not in done.cells]
    waiting.sort(key=lambda job: (-job.count, -len(job.case.scene.bodies)))

    def finished(place: int, answer: Any) -> None:
        job = waiting[place]
        cell = _cell(plan, job, answer)
        done.cells[job.key] = cell
        done.store.add(cell)
        done.seconds[job.count].append(_GUESS if cell.wall_s is None else cell.wall_s + 1.0)
        meter.advance(f"{job.contender.name}, {text_of(job.case.value, plan.study.unit)}")
        left = [other for other in waiting if other.key not in done.cells]
        meter.forecast(math.fsum(_expected(done, other.count) for other in left))

    meter.forecast(_GUESS * len(waiting))
    tasks = [
        Task(
            run_cell,
            (j.case.scene, j.case.batch, j.contender.engine, j.settings, j.case.truth),
            plan.limit,
        )
        for j in waiting
    ]
    run_tasks(tasks, workers=plan.workers, finished=finished)
    return done


def _lasts(cell: Cell, plan: Plan) -> bool:
    """Whether a kept cell need not be run again: a crash may have come from outside."""
    if cell.outcome == "timed out":
        return cell.limit_s >= plan.limit
    return cell.outcome != "crashed"


def _expected(done: _Done, count: int) -> float:
    """Time of a cell by its steps a frame: as those that took as many, else as all [s]."""
    alike = done.seconds.get(count) or [s for times in done.seconds.values() for s in times]
    return statistics.fmean(alike) if alike else _GUESS


def _cell(plan: Plan, job: _Job, answer: Judged | Crash) -> Cell:
    adapter = registry.load_adapter(job.contender.engine)
    settings = job.settings
    bare = Cell(
        key=job.key,
        study=plan.study.name,
        value=job.case.value,
        engine=job.contender.engine,
        version=adapter.version(),
        method=settings.method,
        family=adapter.methods[settings.method].family,
        profile=job.contender.profile,
        options=dict(settings.options),
        step_s=settings.step,
        duration_s=job.case.scene.clock.duration,
        limit_s=plan.limit,
        machine=machine(),
        outcome="crashed",
        told="process",
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


def _panel(contender: Contender, rows: list[list[_Job]], done: _Done) -> Panel:
    adapter = registry.load_adapter(contender.engine)
    return Panel(
        engine=contender.engine,
        version=adapter.version(),
        method=contender.method,
        family=adapter.methods[contender.method].family,
        profile=contender.profile,
        cells=tuple(tuple(done.cells[job.key] for job in row) for row in rows),
    )


def _versions(engines: Iterable[str]) -> dict[str, str]:
    versions = {name: registry.package_version(name) for name in ("mbds-xsim", "numpy", "scipy")}
    versions["python"] = platform.python_version()
    return versions | {name: registry.load_adapter(name).version() for name in engines}
