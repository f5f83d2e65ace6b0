"""Execution of a study: all simulators at all values and steps, isolated in processes.

The steps of one engine's method at one value share a process. All values of one trained model do
so, too, because torch takes longer to start than a prediction.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from mbds_xsim import reference
from mbds_xsim.base.errors import InputError, Unsupported, check_name
from mbds_xsim.base.isolate import USUAL, Conduct, Crash, Task, run_tasks
from mbds_xsim.measure.runner import (
    Runner,
    Store,
    StudyCase,
    in_time,
    machine,
    row_key,
    versions_of,
)
from mbds_xsim.reference import FirstImpact
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.simulate.simulator import NATIVE, EngineMethod, Simulator
from mbds_xsim.studies.stability import (
    COUNTS,
    SCHEMA,
    MapCell,
    Panel,
    Study,
    Survey,
    Value,
    text_of,
)
from mbds_xsim.studies.stability.verdict import CRITERIA, run_cell

LIMIT = 30.0
"""Time limit of a cell [s]."""
_REFERENCE_LIMIT = 120.0  # [s]
_NO_REFERENCE = Crash("rigid contact of several spheres has no unique solution")


@dataclass(frozen=True)
class SurveyPlan:
    """Plan of a study: the parts to carry out, and how."""

    study: Study
    engines: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    """Methods to try; empty: all of each engine."""
    profiles: tuple[Profile, ...] = ("matched", "native")
    values: tuple[Value, ...] = ()
    """Values to try; empty: the study's own."""
    counts: tuple[int, ...] = COUNTS
    """Numbers of steps per frame, the fewest first."""
    limit: float = LIMIT
    """Time limit of a cell [s]."""
    conduct: Conduct = USUAL
    command: str = ""
    others: tuple[Simulator, ...] = ()
    """Simulators in addition to the engines' methods."""
    faulty: Mapping[str, str] = field(default_factory=dict)
    """Engines that would take part but cannot be used, each with the reason."""


@dataclass(frozen=True, eq=False)
class Instance:
    """The scene at one value, with its start and its reference if known."""

    value: Value
    scene: Scene
    batch: Batch
    truth: Trajectory | None


def survey(plan: SurveyPlan) -> Survey:
    """Carry out a study; cells that were measured earlier are taken from the store.

    Raises:
        InputError: No method can simulate any of the scenes, or settings are not allowed.
    """
    begin = time.perf_counter()
    plan = replace(plan, values=plan.values or plan.study.values)
    simulators, left_out = simulators_of(plan)
    instances, unknown = _instances(plan, simulators)
    runner = Runner(
        store=Store.of("stability", plan.study.name, MapCell),
        crashed=_crash_cell,
        labels=("value", "profile", "source"),
        lasts=_lasts,
        conduct=plan.conduct,
    )
    panels = _panels(plan, simulators, instances, runner)
    return Survey(
        schema=SCHEMA,
        study=plan.study.name,
        sentence=plan.study.sentence,
        quantity=plan.study.quantity,
        unit=plan.study.unit,
        values=plan.values,
        steps_s=tuple(plan.study.clock.frame / count for count in plan.counts),
        duration_s=plan.study.clock.duration,
        criteria=CRITERIA,
        panels=panels,
        left_out=left_out | dict(plan.faulty),
        unknown=unknown,
        command=plan.command,
        versions=versions_of({simulator.package: simulator.version for simulator in simulators}),
        machine=machine(),
        workers=plan.conduct.processes,
        measured=runner.measured,
        kept=runner.reused,
        wall_s=time.perf_counter() - begin,
    )


def simulators_of(plan: SurveyPlan) -> tuple[list[Simulator], dict[str, str]]:
    """List the simulators that take part, and those that are left out, with the reason.

    `matched` takes every method, `native` the one that a user of the engine gets by default.

    Raises:
        InputError: No simulator takes part, or a named method belongs to none of the engines.
    """
    candidates: list[Simulator] = []
    left_out: dict[str, str] = {}
    scenes = [plan.study.scene(value) for value in plan.values]
    for name, profile in itertools.product(plan.engines, plan.profiles):
        adapter = registry.load_adapter(name)
        try:
            usual = adapter.settings(scenes[0], "native").method
        except Unsupported as error:
            left_out[name] = str(error)
            continue
        variation = NATIVE if profile == "native" else ""
        for method in [usual] if profile == "native" else adapter.methods:
            if plan.methods and method not in plan.methods:
                continue
            if adapter.methods[method].adaptive:
                left_out[f"{name} {method}"] = (
                    f"{name} {method} chooses its steps, which a map sets"
                )
                continue
            candidates.append(
                EngineMethod(name, method, variation=variation, counts=plan.counts, profile=profile)
            )
    simulators: list[Simulator] = []
    for simulator in [*candidates, *plan.others]:
        reasons = [_refusal(plan.study, simulator, scene) for scene in scenes]
        if all(reasons):
            left_out[simulator.name] = reasons[0]
        else:
            simulators.append(simulator)
    known = {method for name in plan.engines for method in registry.load_adapter(name).methods}
    for method in plan.methods:
        check_name("method of these engines", method, sorted(known))
    if not simulators:
        reason = next(iter(left_out.values()), "no method that is named belongs to these settings")
        raise InputError(f"nothing to run in {plan.study.name}: {reason}")
    return simulators, left_out


def _refusal(study: Study, simulator: Simulator, scene: Scene) -> str:
    if simulator.context and not study.known:
        return f"{simulator.name}: no reference is known to give it its first frames"
    return simulator.refusal(scene)


def _instances(
    plan: SurveyPlan, simulators: Sequence[Simulator]
) -> tuple[dict[Clock, list[Instance]], dict[str, str]]:
    """Make the scenes, with their references, for each clock that simulators record with.

    Values that have no reference are also returned with the reason.
    """
    instances: dict[Clock, list[Instance]] = {}
    unknown: dict[str, str] = {}
    for clock in dict.fromkeys(simulator.clock(plan.study.clock) for simulator in simulators):
        scenes = [plan.study.scene(value, clock) for value in plan.values]
        starts = [(scene, plan.study.batch(scene)) for scene in scenes]
        answers: list[Any] = [_NO_REFERENCE] * len(starts)
        if plan.study.known:
            cache = plan.conduct.cache
            tasks = [Task(_truth, (*start, cache), _REFERENCE_LIMIT) for start in starts]
            answers = run_tasks(tasks, workers=plan.conduct.workers)
        instances[clock] = []
        for value, start, answer in zip(plan.values, starts, answers, strict=True):
            failure = answer if isinstance(answer, Crash) else answer.failures[0]
            known = failure is None or isinstance(failure, FirstImpact)
            if not known:
                unknown[text_of(value)] = failure.reason
            instances[clock].append(Instance(value, *start, answer if known else None))
    return instances, unknown


def _truth(scene: Scene, batch: Batch, cache: bool) -> Trajectory:
    return reference.solve(scene, batch, cache=cache)


def _panels(
    plan: SurveyPlan,
    simulators: Sequence[Simulator],
    instances: Mapping[Clock, Sequence[Instance]],
    runner: Runner[MapCell],
) -> tuple[Panel, ...]:
    """Run all cells, those of most bodies first as they take longest, and arrange the panels."""
    grid = [
        [
            _row(plan, simulator, instance)
            for instance in instances[simulator.clock(plan.study.clock)]
        ]
        for simulator in simulators
    ]
    cases = [case for panel in grid for row in panel for case in row if case.row.key]
    cases.sort(key=lambda case: -len(case.arguments()[1].bodies))
    ran = dict(zip(map(id, cases), runner.rows(cases), strict=True))
    return tuple(
        Panel(
            **_names(simulator),
            cells=tuple(tuple(ran.get(id(case), case.row) for case in row) for row in panel),
        )
        for simulator, panel in zip(simulators, grid, strict=True)
    )


def _names(simulator: Simulator) -> dict[str, Any]:
    """Return the fields of cells and panels that say which simulator it is."""
    fields = ("engine", "version", "method", "family", "profile")
    return {field: getattr(simulator, field) for field in fields}


def _row(plan: SurveyPlan, simulator: Simulator, instance: Instance) -> list[StudyCase[MapCell]]:
    """Return the case of each cell of a row."""
    refusal = _refusal(plan.study, simulator, instance.scene)
    return [_planned(plan, simulator, instance, count, refusal) for count in simulator.counts]


def _planned(
    plan: SurveyPlan, simulator: Simulator, instance: Instance, count: int, refusal: str
) -> StudyCase[MapCell]:
    """Return the case of a cell; if the scene is refused, its row has no key and is the cell."""
    scene, batch, truth = instance.scene, instance.batch, instance.truth
    more = (truth is None, batch.steps)
    cell = MapCell(
        key="" if refusal else row_key(scene, batch, simulator, count, *more),
        study=plan.study.name,
        value=instance.value,
        **_names(simulator),
        options={} if simulator.source or refusal else simulator.options(scene),
        step_s=scene.clock.frame / count,
        duration_s=scene.clock.duration,
        limit_s=plan.limit,
        machine=machine(),
        outcome="refused",
        told="process",
        reason=" ".join(refusal.split()),
        source=simulator.source,
    )
    return StudyCase(
        row=cell,
        name=f"{simulator.name}, {text_of(instance.value, plan.study.unit)}",
        function=run_cell,
        arguments=lambda: (simulator, scene, batch, count, truth),
        limit=plan.limit,
        group=simulator.name if simulator.source else (simulator.name, instance.value),
        pace=count,
    )


def _crash_cell(cell: MapCell, crash: Crash) -> MapCell:
    return msgspec.structs.replace(cell, outcome=crash.kind, reason=" ".join(crash.reason.split()))


def _lasts(stored: MapCell, cell: MapCell) -> bool:
    """Return whether a stored cell can be reused; a crash cannot, as its cause may be external."""
    return stored.outcome != "crashed" and in_time(stored, cell)
