"""A study carried out: every engine, method, value and step, each run isolated."""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence

from mbds_xsim import reference
from mbds_xsim.base.isolate import Crash, Task, core_count, run_tasks
from mbds_xsim.base.silence import Silent
from mbds_xsim.measure.identity import machine
from mbds_xsim.reference import FirstImpact
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.studies.stability.contenders import Contender, Job, Plan, contenders_of
from mbds_xsim.studies.stability.definition import FRAME, Case, Value, text_of
from mbds_xsim.studies.stability.rows import SCHEMA, Panel, Sweep
from mbds_xsim.studies.stability.runs import Measuring
from mbds_xsim.studies.stability.verdict import CRITERIA
from mbds_xsim.studies.tradeoff.bench import Meter

_REFERENCE_LIMIT = 120.0  # [s]


def survey(plan: Plan, meter: Meter | None = None) -> Sweep:
    """Carry out a study; what was measured earlier is taken from the store.

    Raises:
        InputError: No method can do any of the scenes, or settings are not allowed.
    """
    begin = time.perf_counter()
    values = plan.values or plan.study.values
    scenes = {value: plan.study.scene(value) for value in values}
    contenders, left_out = contenders_of(
        plan.study, list(scenes.values()), plan.engines, plan.methods, plan.profiles, plan.others
    )
    cases, unknown = _cases(plan, values, contenders)
    grid = [
        [
            [Job.of(case, contender, count) for count in contender.counts(plan.counts)]
            for case in cases[contender.clock(plan.study)]
        ]
        for contender in contenders
    ]
    jobs = [job for panel in grid for row in panel for job in row]
    measuring = Measuring(plan, meter or Silent())
    measuring.run(jobs)
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
            _panel(contender, rows, measuring)
            for contender, rows in zip(contenders, grid, strict=True)
        ),
        left_out=left_out | dict(plan.faulty),
        unknown=unknown,
        command=plan.command,
        versions=_versions(contenders),
        machine=machine(),
        workers=core_count() if plan.workers is None else plan.workers,
        measured=len(jobs) - measuring.kept,
        kept=measuring.kept,
        wall_s=time.perf_counter() - begin,
    )


def _cases(
    plan: Plan, values: Sequence[Value], contenders: Sequence[Contender]
) -> tuple[dict[Clock, list[Case]], dict[str, str]]:
    """Make the scenes at the frames that each contender is recorded at, with what is true there."""
    cases: dict[Clock, list[Case]] = {}
    unknown: dict[str, str] = {}
    for clock in dict.fromkeys(contender.clock(plan.study) for contender in contenders):
        scenes = {value: plan.study.scene(value, clock) for value in values}
        truths, missing = _truths(plan, scenes)
        unknown |= missing
        cases[clock] = [
            Case(value, scene, plan.study.batch(scene), truths.get(value))
            for value, scene in scenes.items()
        ]
    return cases, unknown


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


def _panel(contender: Contender, rows: list[list[Job]], done: Measuring) -> Panel:
    return Panel(
        engine=contender.engine,
        version=contender.version,
        method=contender.method,
        family=contender.family,
        profile=contender.profile,
        cells=tuple(tuple(done.cells[job.key] for job in row) for row in rows),
    )


def _versions(contenders: Sequence[Contender]) -> dict[str, str]:
    versions = {name: registry.package_version(name) for name in ("mbds-xsim", "numpy", "scipy")}
    versions["python"] = platform.python_version()
    for contender in contenders:
        versions |= contender.versions
    return versions
