"""The simulations of a validation: which there are, carried out side by side, put together.

One work item is one engine at one step over some trajectories, or one trajectory's reference.

Three steps come first, the shortest of them no shorter than need be. Where they do not show how
the engine converges, the shortest one is halved, twice at most.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from mbds_xsim import reference
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Crash, Silent, Task, run_tasks
from mbds_xsim.checks import Finding
from mbds_xsim.checks.consistency import LEAST_SPAN, Consistency
from mbds_xsim.measure.runner import Account, Piece, Watch, carry_out
from mbds_xsim.reference import FirstImpact
from mbds_xsim.reference.cache import key_of, load
from mbds_xsim.reference.kernels import compilation, compile_once
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate import rounding
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import REFERENCE, load_adapter
from mbds_xsim.simulate.timed import Simulation, Work, forewarnings, simulate

_CHUNKS = 6  # an engine's trajectories are spread over at most so many processes
_LANES = 8  # trajectories that take the compiled reference as long as one
_REFINEMENT = (2, 4)  # the consistency check compares with steps so many times longer, or shorter
_TIMEOUT = 3600.0
RTOL = 1e-11
"""Of the reference."""
_SAMPLE = 3  # trajectories that run at other steps too


@dataclass
class Outcome:
    """What one contender delivered."""

    contender: Contender
    parts: list[Simulation | Crash] = field(default_factory=list)
    rows: list[list[int]] = field(default_factory=list)
    """Rows of the batch of each part."""
    sample: list[int] = field(default_factory=list)
    """Rows of the batch that run at other steps too, for the consistency check."""
    other_steps: dict[float, Trajectory] = field(default_factory=dict)
    """The sample at each other step [s]."""

    def keep_step(self, step: float, batch: Batch, answer: Simulation | Crash) -> None:
        """Keep the sample's run at another step [s]; NaN, with the reason, where it crashed."""
        if isinstance(answer, Simulation):
            self.other_steps[step] = answer.trajectory
            return
        count = len(self.sample)
        empty = Trajectory.empty(np.arange(batch.steps + 1.0), count, batch.position.shape[1])
        crashed = (Failure(0, answer.reason),) * count
        self.other_steps[step] = dataclasses.replace(empty, failures=crashed)

    @property
    def crashes(self) -> list[str]:
        """Reasons of the parts that crashed."""
        return list(dict.fromkeys(p.reason for p in self.parts if isinstance(p, Crash)))

    @property
    def simulations(self) -> list[Simulation]:
        """The parts that came back."""
        return [part for part in self.parts if isinstance(part, Simulation)]

    def trajectory(self, time: Array, count: int, body_count: int) -> Trajectory | None:
        """Put the parts together; rows of a crashed part are NaN. None where all crashed."""
        if not self.simulations:
            return None
        whole = Trajectory.empty(time, count, body_count)
        for rows, part in zip(self.rows, self.parts, strict=True):
            if isinstance(part, Simulation):
                whole = whole.replaced(np.array(rows), part.trajectory)
        return whole

    def failures(self, batch: Batch) -> list[str]:
        """One line for each crash, and for each trajectory that ended early."""
        lines = [f"crash: {reason}" for reason in self.crashes]
        for rows, part in zip(self.rows, self.parts, strict=True):
            if isinstance(part, Simulation):
                for row, failure in zip(rows, part.trajectory.failures, strict=True):
                    if failure is not None:
                        lines.append(
                            f"{batch.label(row)} ended at frame {failure.frame}: {failure.reason}"
                        )
        return lines


@dataclass(frozen=True, eq=False)
class ReferenceOutcome:
    """The reference of all trajectories."""

    trajectory: Trajectory
    """NaN from a first impact on that has no unique solution."""
    growth: Array
    """Sensitivity G, shape (trajectory, frame); NaN where the trajectory is."""
    rtol: float
    cached: int
    wall_s: float

    @property
    def busy_s(self) -> float:
        """Time that it took [s]."""
        return self.wall_s

    def __getitem__(self, rows: list[int]) -> ReferenceOutcome:
        """Take some of the trajectories."""
        return dataclasses.replace(self, trajectory=self.trajectory[rows], growth=self.growth[rows])


def run_campaign(
    scene: Scene,
    batch: Batch,
    contenders: list[Contender],
    *,
    cache: bool,
    workers: int | None,
    progress: Watch,
    spent: Account,
) -> tuple[list[Outcome], ReferenceOutcome]:
    """Simulate everything; engines while the reference is compiled, where it has to be.

    What it takes is added to `spent`, the seconds of processes by what they did.

    Raises:
        InputError: The reference could not be had; without it nothing can be judged.
    """
    outcomes = [Outcome(contender) for contender in contenders]
    references: list[Any] = []
    before: list[Piece] = []
    work = [
        Piece(
            REFERENCE,
            REFERENCE,
            Task(reference_of, (scene, batch[rows], cache), _TIMEOUT),
            references.append,
        )
        for rows in _reference_chunks(scene, len(batch))
    ]
    compiling = None if scene.contacts else compilation(progress.notice)
    if compiling is not None:
        before.append(Piece("compiler", "compiler", *compiling))
    for outcome in outcomes:
        waits = compiling is None or _method(outcome.contender).is_truth
        (work if waits else before).extend(_engine_work(scene, batch, outcome))
    progress.begin(len(before) + len(work))
    progress.doing("costs of the runs")
    costs = [_work_of(scene, batch, outcome) for outcome in outcomes]
    for line in forewarnings(scene, batch[[0]], costs, workers=workers):
        progress.notice(line)
    for pieces in filter(None, (before, work)):
        carry_out(pieces, progress, spent, workers=workers)
    return outcomes, _joined(references)


def run_references(
    scene: Scene,
    batch: Batch,
    *,
    cache: bool,
    workers: int | None,
    notice: Callable[[str], None] | None = None,
) -> ReferenceOutcome:
    """Solve the reference of every trajectory, or take it from the cache.

    Raises:
        InputError: The reference could not be had; without it nothing can be judged.
    """
    if not scene.contacts:
        compile_once(notice or Silent().notice, workers=workers)
    parts = [
        Task(reference_of, (scene, batch[rows], cache), _TIMEOUT)
        for rows in _reference_chunks(scene, len(batch))
    ]
    return _joined(run_tasks(parts, workers=workers))


def _engine_work(scene: Scene, batch: Batch, outcome: Outcome) -> list[Piece]:
    contender, work = outcome.contender, []
    name = _step_name(contender, contender.settings.step)
    for rows in _chunks(len(batch)):
        arguments = (scene, batch[rows], contender.engine, contender.settings)
        outcome.rows.append(rows)
        task = Task(simulate, arguments, contender.limit)
        work.append(Piece(name, contender.engine, task, outcome.parts.append))
    outcome.sample = list(range(min(_SAMPLE, len(batch))))
    for step in other_steps(scene, contender.engine, contender.settings):
        work.append(_step_piece(scene, batch, outcome, step))
    return work


def _work_of(scene: Scene, batch: Batch, outcome: Outcome) -> Work:
    """Sum up the steps of all runs."""
    contender = outcome.contender
    steps = [len(batch) * scene.clock.duration / contender.settings.step]
    others = other_steps(scene, contender.engine, contender.settings)
    steps += [len(outcome.sample) * scene.clock.duration / step for step in others]
    return Work(contender.name, contender.engine, contender.settings, sum(steps))


def _step_piece(scene: Scene, batch: Batch, outcome: Outcome, step: float) -> Piece:
    """Run the sample of an engine at another step [s]."""
    contender = outcome.contender
    settings = Settings(contender.settings.method, step, contender.settings.options)
    arguments = (scene, batch[outcome.sample], contender.engine, settings)
    task = Task(simulate, arguments, contender.limit)
    keep = partial(outcome.keep_step, step, batch)
    return Piece(_step_name(contender, step), contender.engine, task, keep)


def _step_name(contender: Contender, step: float) -> str:
    return f"{contender.name}, step {step:.3g} s"


def _method(contender: Contender) -> Method:
    return load_adapter(contender.engine).methods[contender.settings.method]


def other_steps(scene: Scene, engine: str, settings: Settings) -> list[float]:
    """Give the consistency check's steps: longer ones where they divide the frame, else shorter.

    None for an adaptive method, which takes no step from its settings.
    """
    if load_adapter(engine).methods[settings.method].adaptive:
        return []
    count = settings.substeps(scene.clock.frame)
    longer = all(count % factor == 0 for factor in _REFINEMENT)
    return [
        scene.clock.frame / (count // factor if longer else count * factor)
        for factor in _REFINEMENT
    ]


def _chunks(count: int, *, least: int = 1) -> list[list[int]]:
    """Part rows evenly, into as many pieces as there would be of so many rows at the most."""
    parts = min(_CHUNKS, -(-count // least))
    return [rows.tolist() for rows in np.array_split(np.arange(count), parts)]


def _reference_chunks(scene: Scene, count: int) -> list[list[int]]:
    """Let the compiled reference have as many as it does at once."""
    return _chunks(count, least=1 if scene.contacts else _LANES)


def reference_of(scene: Scene, batch: Batch, cache: bool) -> ReferenceOutcome:
    """Solve the reference of some trajectories, with its sensitivity, in this process."""
    begin = time.perf_counter()
    keys = [key_of("solve", scene, batch, row, RTOL) for row in range(len(batch))]
    kept = sum(load(key) is not None for key in keys) if cache else 0
    trajectory = reference.solve(scene, batch, rtol=RTOL, cache=cache)
    growth = reference.sensitivity(scene, batch, cache=cache)
    growth[~np.isfinite(trajectory.position).all(axis=(2, 3))] = np.nan
    return ReferenceOutcome(trajectory, growth, RTOL, kept, time.perf_counter() - begin)


def _joined(parts: list[Any]) -> ReferenceOutcome:
    crashed = [part.reason for part in parts if isinstance(part, Crash)]
    crashed += [
        f.reason
        for part in parts
        if not isinstance(part, Crash)
        for f in part.trajectory.failures
        if f is not None and not isinstance(f, reference.FirstImpact)
    ]
    if crashed:
        msg = f"the reference solution failed, so nothing can be judged: {crashed[0]}"
        raise InputError(msg)
    return ReferenceOutcome(
        trajectory=Trajectory.joined([part.trajectory for part in parts]),
        growth=np.concatenate([part.growth for part in parts]),
        rtol=RTOL,
        cached=sum(part.cached for part in parts),
        wall_s=sum(part.wall_s for part in parts),
    )


_RUNS = 5
"""Steps at most, of which the shortest is 1/16 of the longest."""
_PATIENCE = 300.0
"""No further run is made that would take longer [s]."""


def convergence(
    scene: Scene, batch: Batch, outcome: Outcome, reference: ReferenceOutcome
) -> list[Finding]:
    """Extrapolate the sample that ran at several steps to a vanishing step.

    Only smooth motion has an order of convergence: with contact, what comes before it.
    """
    given = _given(scene, batch, outcome, reference)
    return [] if given is None else given.findings


def further_step(
    scene: Scene, batch: Batch, outcome: Outcome, reference: ReferenceOutcome
) -> float | None:
    """Give the step at which the sample must run too before anything can be said [s].

    None where that is not so, where the engine fails anyway, or where it would take too long.
    """
    if len(outcome.other_steps) + 1 >= _RUNS or outcome.failures(batch):
        return None
    given = _given(scene, batch, outcome, reference)
    if given is None or not given.unsettled:
        return None
    step = outcome.contender.settings.step
    half = min(step, *outcome.other_steps) / 2.0
    simulated = sum(len(part.trajectory) for part in outcome.simulations)
    each = sum(part.rollout_s for part in outcome.simulations) / simulated
    return half if each * len(outcome.sample) * step / half < _PATIENCE else None


def refine(
    scene: Scene,
    batch: Batch,
    outcomes: list[Outcome],
    reference: ReferenceOutcome,
    *,
    workers: int | None,
    progress: Watch,
    spent: Account,
) -> None:
    """Run samples at further steps until they show how each engine converges."""
    while True:
        steps = [further_step(scene, batch, outcome, reference) for outcome in outcomes]
        asked = [(o, step) for o, step in zip(outcomes, steps, strict=True) if step is not None]
        if not asked:
            return
        progress.begin(len(asked))
        pieces = [_step_piece(scene, batch, outcome, step) for outcome, step in asked]
        carry_out(pieces, progress, spent, workers=workers)


def _given(
    scene: Scene, batch: Batch, outcome: Outcome, reference: ReferenceOutcome
) -> Consistency | None:
    """Give what the check is about; None where nothing is to be compared."""
    flies = smooth(scene, reference)
    smooth_ones = [k for k, row in enumerate(outcome.sample) if flies[row]]
    rows = [outcome.sample[k] for k in smooth_ones]
    truth, contender = reference.trajectory, outcome.contender
    trajectory = outcome.trajectory(truth.time, len(batch), len(scene.bodies))
    if trajectory is None or not rows or not outcome.other_steps:
        return None
    runs = {step: run[smooth_ones] for step, run in outcome.other_steps.items()}
    runs[contender.settings.step] = trajectory[rows]
    method = _method(contender)
    ordered = [runs[step] for step in sorted(runs, reverse=True)]
    growth = reference.growth[rows]
    most = rounding.stepped(method, round(float(truth.time[-1]) / min(runs)))
    known = max(Consistency.resolution, most)
    return Consistency(scene, batch[rows], ordered, truth[rows], method, growth, known)


def smooth(scene: Scene, reference: ReferenceOutcome) -> list[bool]:
    """Tell of each trajectory whether it begins with smooth motion, long enough to be judged.

    The reference follows balls through impacts; of any other contact it ends at the first.
    """
    ends = reference.trajectory.failures
    if not scene.contacts:
        return [True] * len(ends)
    balls = Mechanism.of(scene).has_only_balls
    return [not balls if end is None else _flies(end) for end in ends]


def _flies(end: Failure) -> bool:
    return isinstance(end, FirstImpact) and end.frame > LEAST_SPAN
