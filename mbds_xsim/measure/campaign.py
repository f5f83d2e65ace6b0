"""The simulations of a validation: planned, carried out in parallel, and put together.

One work item is one engine at one step over some trajectories, or one trajectory's reference.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mbds_xsim import reference
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Conduct, Crash, Task, run_tasks
from mbds_xsim.checks.audit import audited
from mbds_xsim.checks.integrity import gap
from mbds_xsim.checks.record import Record
from mbds_xsim.measure.outcome import Outcome, ReferenceOutcome
from mbds_xsim.measure.refinement import may_end, other_steps, pieces_of, step_name
from mbds_xsim.measure.runner import Account, Piece, carry_out
from mbds_xsim.reference.cache import key_of, load
from mbds_xsim.reference.kernels import compilation, compile_once
from mbds_xsim.scene.reach import doubted_length
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.registry import REFERENCE
from mbds_xsim.simulate.timed import Work, forewarnings, simulate

_CHUNKS = 6  # an engine's trajectories are spread over at most so many processes
_LANES = 8  # trajectories that the compiled reference solves in the time of one
_TIMEOUT = 3600.0
RTOL = 1e-11
"""Relative tolerance of the reference."""
_OPEN = 1e-6  # of the scene's length: a joint gap too large for a reference
_SAMPLE = 3  # trajectories that run at other steps too, in one process


def run_campaign(
    scene: Scene,
    batch: Batch,
    contenders: list[Contender],
    conduct: Conduct,
    spent: Account,
    then: Callable[[Outcome, ReferenceOutcome], object] = lambda *_: None,
) -> tuple[list[Outcome], ReferenceOutcome]:
    """Run all simulations; engines start while the reference is compiled, if it has to be.

    The elapsed time of processes [s] is added to `spent` by purpose. An engine's outcome goes to
    `then` once it is complete and the reference is available, while others still run.

    Raises:
        InputError: The reference failed; without it nothing can be judged.
    """
    outcomes, meter = [Outcome(each, scene, batch) for each in contenders], conduct.meter
    references: list[Any] = []
    compiling = None if scene.contacts else compilation(meter.notice)
    compiled = None if compiling is None else 0
    work = [] if compiling is None else [Piece("compiler", "compiler", *compiling)]
    for task in _reference_tasks(scene, batch, conduct.cache, compiled):
        work.append(Piece(REFERENCE, REFERENCE, task, references.append))
    for outcome in outcomes:
        work += _engine_work(outcome, after=compiled if outcome.method.is_truth else None)
    meter.begin(len(work))
    if doubt := doubted_length(scene):
        meter.notice(doubt)
    meter.doing("costs of the runs")
    costs = [_work_of(outcome) for outcome in outcomes]
    for line in forewarnings(scene, batch[[0]], costs, workers=conduct.workers):
        meter.notice(line)
    reference: ReferenceOutcome | None = None
    complete: list[Outcome] = []

    def done(purpose: str) -> None:
        nonlocal reference
        if purpose == REFERENCE:
            reference = _joined(references)
        complete.extend(each for each in outcomes if each.contender.engine == purpose)
        while reference is not None and complete:
            then(complete.pop(0), reference)

    if may_end(scene):
        carry_out(work, conduct, spent)
        reference = _joined(references)
        work = [piece for each in outcomes for piece in pieces_of(each, reference)]
        meter.begin(len(work))
    carry_out(work, conduct, spent, done)
    return outcomes, reference or _joined(references)


def run_references(scene: Scene, batch: Batch, conduct: Conduct) -> ReferenceOutcome:
    """Solve the reference of every trajectory, or take it from the cache.

    Raises:
        InputError: The reference failed; without it nothing can be judged.
    """
    if not scene.contacts:
        compile_once(conduct.meter.notice, workers=conduct.workers)
    tasks = _reference_tasks(scene, batch, conduct.cache)
    return _joined(run_tasks(tasks, workers=conduct.workers))


def _engine_work(outcome: Outcome, after: int | None) -> list[Piece]:
    contender, batch, work = outcome.contender, outcome.batch, []
    name = step_name(contender, contender.settings.step)
    for rows in _chunks(len(batch), least=_SAMPLE):
        arguments = (outcome.scene, batch[rows], contender.engine, contender.settings)
        outcome.rows.append(rows)
        task = Task(simulate, arguments, contender.limit, after)
        work.append(Piece(name, contender.engine, task, outcome.parts.append))
    outcome.sample = list(range(min(_SAMPLE, len(batch))))
    return work if may_end(outcome.scene) else pieces_of(outcome) + work


def _work_of(outcome: Outcome) -> Work:
    """Sum up the steps of all runs."""
    contender, scene = outcome.contender, outcome.scene
    steps = [len(outcome.batch) * scene.clock.duration / contender.settings.step]
    others = other_steps(scene, contender)
    steps += [len(outcome.sample) * scene.clock.duration / step for step in others]
    return Work(contender.name, contender.engine, contender.settings, sum(steps))


def _chunks(count: int, *, least: int) -> list[list[int]]:
    """Split rows evenly into ⌈count / least⌉ pieces, but at most `_CHUNKS`."""
    parts = min(_CHUNKS, -(-count // least))
    return [rows.tolist() for rows in np.array_split(np.arange(count), parts)]


def _reference_tasks(
    scene: Scene, batch: Batch, cache: bool, after: int | None = None
) -> list[Task]:
    """Split the reference into chunks of `_LANES` (1 with contact), or larger beyond `_CHUNKS`."""
    chunks = _chunks(len(batch), least=1 if scene.contacts else _LANES)
    return [Task(reference_of, (scene, batch[rows], cache), _TIMEOUT, after) for rows in chunks]


def reference_of(scene: Scene, batch: Batch, cache: bool) -> ReferenceOutcome:
    """Solve the reference of some trajectories, with its sensitivity, in this process."""
    begin = time.perf_counter()
    keys = [key_of("solve", scene, batch, row, RTOL) for row in range(len(batch))]
    cached = sum(load(key) is not None for key in keys) if cache else 0
    trajectory = reference.solve(scene, batch, rtol=RTOL, cache=cache)
    _check_closed(scene, batch, trajectory)
    growth = reference.sensitivity(scene, batch, cache=cache)
    growth[~trajectory.known] = np.nan
    return ReferenceOutcome(trajectory, growth, RTOL, cached, time.perf_counter() - begin)


def _check_closed(scene: Scene, batch: Batch, trajectory: Trajectory) -> None:
    """Raise InputError if the reference opens a joint, since it cannot judge engines then."""
    for finding in audited(Record(scene, batch, trajectory), (gap,)):
        worst = finding.worst
        if finding.figure[worst] > _OPEN * scene.length:
            raise InputError(
                f"the reference opens {finding.where[worst]} by {finding.figure[worst]:.3g} m, so "
                "nothing can be judged: masses, inertias or lengths of the bodies differ too much"
            )


def _joined(parts: list[Any]) -> ReferenceOutcome:
    ends = [part for part in parts if isinstance(part, Crash)] or [
        end for part in parts for end in part.trajectory.failures
    ]
    reasons = [e.reason for e in ends if e is not None and not isinstance(e, reference.FirstImpact)]
    if reasons:
        raise InputError(f"the reference solution failed, so nothing can be judged: {reasons[0]}")
    return ReferenceOutcome(
        trajectory=Trajectory.joined([part.trajectory for part in parts]),
        growth=np.concatenate([part.growth for part in parts]),
        rtol=RTOL,
        cached=sum(part.cached for part in parts),
        busy_s=sum(part.busy_s for part in parts),
    )
