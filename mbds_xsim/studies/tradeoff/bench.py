"""Measurement of chart points: one start at one setting, timed and compared with the truth.

The truth is the reference, or a method's own limit if the reference ends at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.base.isolate import Conduct, Crash, Task, run_tasks
from mbds_xsim.checks import agreement, audit
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.measure.judge import reference_findings, worst_of
from mbds_xsim.measure.runner import Runner, Store, StudyCase, in_time, machine, row_key
from mbds_xsim.reference import FirstImpact
from mbds_xsim.reference.solution import confirmed
from mbds_xsim.scene.collisions import has_known_impacts
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.simulator import Signs, Simulated, Simulator
from mbds_xsim.studies.tradeoff import SPAN, Measurement

LIMIT_COUNT = 2 * SPAN
"""Steps per frame of the run that stands for the limit of a vanishing step."""

_LOST_LIMIT = "limit unknown"
"""Mark in the key of a row that has no limit to be compared with."""
_GRACE = 30.0
"""Time that a case may take in addition to its rollouts [s]."""
_LIMIT_PATIENCE = 5.0

Place = tuple[str, str, int]
"""Engine, method and row of the batch."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Motion that one start is compared with."""

    trajectory: Trajectory
    growth: Array
    """Sensitivity G, shape (1, frame)."""
    judged: bool = True
    """Whether the error counts against a budget; False if a method is compared with itself."""
    compared: bool = True
    """Whether there is an error at all."""

    @property
    def known(self) -> Mask:
        """Whether each frame is known, shape (frame,)."""
        return np.asarray(self.trajectory.known.all(axis=0))

    @property
    def horizon(self) -> float:
        """Time of the charted error [s]: that of the frame that stands for 1 s, or of the last
        known frame before that; 0 if only the start is known."""
        return _horizon(self.trajectory.time, self.known)


def _horizon(time: Array, known: Mask) -> float:
    second = agreement.second(time[1])
    before = time[: second + 1][known[: second + 1]]
    return float(before[-1]) if len(before) else 0.0


def references(scene: Scene, batch: Batch, conduct: Conduct) -> list[Truth]:
    """Solve the reference of each start.

    Raises:
        InputError: A solution failed; without it no error can be measured.
    """
    outcome = run_references(scene, batch, conduct)
    parts = (outcome[[k]] for k in range(len(batch)))
    return [Truth(part.trajectory, part.growth) for part in parts]


def confirmations(
    scene: Scene, batch: Batch, truths: Sequence[Truth], conduct: Conduct
) -> list[Truth]:
    """Solve each start with other equations, so that the reference is not compared with itself.

    Bouncing balls have no second solution: the reference then has a cost but no error.
    """
    unknown = [dataclasses.replace(truth, compared=False) for truth in truths]
    if has_known_impacts(Mechanism.of(scene)):
        return unknown
    tasks = [Task(confirmed, (scene, batch[[k]], conduct.cache)) for k in range(len(batch))]
    answers = run_tasks(tasks, workers=conduct.workers)
    return [
        without if isinstance(answer, Crash) else dataclasses.replace(truth, trajectory=answer)
        for truth, without, answer in zip(truths, unknown, answers, strict=True)
    ]


def _limit(simulator: Simulator, scene: Scene, start: Batch) -> Truth:
    motion = simulator.simulate(scene, start, LIMIT_COUNT, None, often=False).motion
    assert isinstance(motion, Trajectory)  # simulators without bodies need a reference
    return _own_limit(motion)


def _own_limit(motion: Trajectory) -> Truth:
    return Truth(motion, np.ones((1, len(motion.time))), judged=False)


_PATIENCE = 3.0
"""Time limit of a case over that of a rollout: predictions can be wrong and machines stall."""


@dataclass(frozen=True)
class Job:
    """One start at one setting."""

    simulator: Simulator
    count: int
    """Steps per frame, or digits of the tolerance."""
    start: int
    """Row of the batch."""

    @property
    def place(self) -> Place:
        """Engine, method and start, which decide the truth."""
        return self.simulator.engine, self.simulator.method, self.start


@dataclass
class StartBench:
    """Starts of a study with their truths, and the runner that measures them.

    There is one truth per start, or one per start and method.
    """

    scene: Scene
    batch: Batch
    references: list[Truth]
    seed: int
    limit: float
    """Longest rollout of one start allowed [s]."""
    conduct: Conduct
    usual: Mapping[tuple[str, str], Simulator] = field(default_factory=dict)
    """Simulators with the engine's usual options, keyed by engine and method."""
    own: Mapping[tuple[str, str], list[Truth]] = field(default_factory=dict)
    """Truths for methods that are the reference itself, keyed by engine and method."""
    _limits: dict[Place, Truth] = field(default_factory=dict)

    @cached_property
    def runner(self) -> Runner[Measurement]:
        """Runner with the scene's store."""
        return Runner(
            store=Store.of("tradeoff", self.scene.name, Measurement),
            crashed=_crash_row,
            labels=("scene", "variation", "trajectory", "seed", "horizon_s"),
            lasts=_lasts,
            conduct=self.conduct,
            forecasts=False,
        )

    @property
    def are_limits(self) -> bool:
        """Whether the reference ends at once, so that a method is only compared with itself."""
        return min(truth.horizon for truth in self.references) == 0.0

    @property
    def horizon(self) -> float:
        """Time of the charted error [s], the earliest of all starts."""
        if self.are_limits:
            time = self.references[0].trajectory.time
            return _horizon(time, np.isfinite(time))
        return min(truth.horizon for truth in self.references)

    @property
    def reference_ends(self) -> float | None:
        """Time of the first impact after which a motion has no unique solution [s]."""
        ends = [truth.trajectory.failures[0] for truth in self.references]
        return min((end.time for end in ends if isinstance(end, FirstImpact)), default=None)

    def rows(self, jobs: Sequence[Job]) -> list[Measurement]:
        """Return the row of each job, measuring those that are not stored."""
        cases = [self._case(job) for job in jobs]
        missing = {case.row.key for case in self.runner.missing(cases)}
        pairs = zip(jobs, cases, strict=True)
        self._prepare([job.place for job, case in pairs if case.row.key in missing])
        # Rows without a limit are kept apart: a later run may have it.
        return self.runner.rows(
            [
                self._case(job, self._is_lost(job.place)) if case.row.key in missing else case
                for job, case in zip(jobs, cases, strict=True)
            ]
        )

    def _is_lost(self, place: Place) -> bool:
        """Return whether a place needs a limit whose process gave no answer."""
        return self.are_limits and not self._limits[place].known.any()

    def _prepare(self, places: Sequence[Place]) -> None:
        """Simulate the limits that the places need and that are still missing."""
        if not self.are_limits:
            return
        missing = [place for place in dict.fromkeys(places) if place not in self._limits]
        timeout = _GRACE + _LIMIT_PATIENCE * self.limit
        tasks = [
            Task(_limit, (self.usual[engine, method], self.scene, self.batch[[start]]), timeout)
            for engine, method, start in missing
        ]
        answers = run_tasks(tasks, workers=self.conduct.workers)
        # A limit that crashed has no known frame.
        time = self.references[0].trajectory.time
        unknown = _own_limit(Trajectory.empty(time, 1, len(self.scene.bodies)))
        for place, answer in zip(missing, answers, strict=True):
            self._limits[place] = unknown if isinstance(answer, Crash) else answer

    def truth_of(self, place: Place) -> Truth:
        """Return the truth for one start in one method."""
        if self.are_limits:
            return self._limits[place]
        return self.own.get(place[:2], self.references)[place[2]]

    def too_slow(self, simulator: Simulator, count: int, predicted: float) -> Measurement:
        """Return the row of a point whose predicted time exceeds the limit."""
        digits = ".0f" if predicted >= 1.0 else ".2g"
        reason = f"predicted {predicted:{digits}} s a start, limit {self.limit:g} s"
        row = self._bare(Job(simulator, count, 0))
        return msgspec.structs.replace(row, key="", kind="too slow", reason=reason)

    def _case(self, job: Job, lost: bool = False) -> StudyCase[Measurement]:
        start, simulator = self.batch[[job.start]], job.simulator
        return StudyCase(
            row=self._bare(job, lost),
            name=simulator.name,
            function=measure,
            arguments=lambda: (simulator, self.scene, start, job.count, self.truth_of(job.place)),
            limit=_PATIENCE * self.limit + _GRACE,
            group=simulator.source or None,
        )

    def _bare(self, job: Job, lost: bool = False) -> Measurement:
        """Return a row without figures; `lost` if there is no limit to compare it with."""
        simulator, more = job.simulator, [_LOST_LIMIT] if lost else []
        options = simulator.options(self.scene)
        if self.are_limits:  # the limit is that of the usual options
            usual = self.usual[job.place[:2]].options(self.scene)
            more += [str(sorted(usual.items()))] if usual != options else []
        return Measurement(
            key=row_key(self.scene, self.batch[[job.start]], simulator, job.count, *more),
            scene=self.scene.name,
            engine=simulator.engine,
            version=simulator.version,
            method=simulator.method,
            variation=simulator.variation,
            options=options,
            steps_per_frame=1 if simulator.digits else job.count,
            step_s=self.scene.clock.frame / (1 if simulator.digits else job.count),
            rtol=10.0**-job.count if simulator.digits else None,
            trajectory=int(self.batch.index[job.start]),
            seed=self.seed,
            machine=machine(),
            limit_s=self.limit,
            kind="done",
            horizon_s=self.horizon if self.are_limits else self.truth_of(job.place).horizon,
        )


def _lasts(stored: Measurement, row: Measurement) -> bool:
    """Return whether a stored row can be reused; a crash cannot, as its cause may be external."""
    return stored.kind != "crashed" and in_time(stored, row)


def _crash_row(row: Measurement, crash: Crash) -> Measurement:
    return msgspec.structs.replace(row, kind=crash.kind, reason=" ".join(crash.reason.split()))


def measure(
    simulator: Simulator, scene: Scene, start: Batch, count: int, truth: Truth
) -> dict[str, Any]:
    """Simulate a batch of one in this process, at `count` steps or digits; return its figures.

    Raises:
        InputError: The simulator cannot do the scene or the settings are not allowed.
    """
    run = simulator.simulate(scene, start, count, truth.trajectory, often=True)
    figures = (
        _of_particles(scene, run.motion, truth)
        if isinstance(run.motion, Signs)
        else _of_bodies(scene, start, run.motion, run, truth)
    )
    return {
        "wall_s": tuple(wall / run.simulated_s for wall in run.wall_s),
        "cpu_s": tuple(cpu / run.simulated_s for cpu in run.cpu_s),
        "setup_s": run.setup_s,
        **({} if run.size is None else vars(run.size)),
        **figures,
    }


def _of_bodies(
    scene: Scene, start: Batch, motion: Trajectory, run: Simulated, truth: Truth
) -> dict[str, Any]:
    """Judge a motion by all checks, and by its distance to the truth."""
    failure = motion.failures[0]
    if failure is not None:
        reason = " ".join(f"frame {failure.frame}: {failure.reason}".split())
        return {"kind": "failed", "reason": reason}
    error = agreement.particle_error(Mechanism.of(scene), motion, truth.trajectory)
    errors = _errors(scene, error, truth)
    findings = audit(scene, start, motion, run.method, step=run.step, contact_time=run.contact_time)
    by_check = {finding.check: finding for finding in findings}
    if truth.horizon > 0.0 and truth.compared and truth.judged:
        known = truth.trajectory, truth.growth
        findings = [*reference_findings(scene, start, motion, error, *known), *findings]
    return errors | {
        "gap_m": worst_of(by_check, "gap"),
        "energy": worst_of(by_check, "passivity" if scene.contacts else "energy"),
        "broken": tuple(one.check for one in findings if not one.passed.all()),
    }


def _of_particles(scene: Scene, signs: Signs, truth: Truth) -> dict[str, Any]:
    """Judge a motion of particles only; one that contains NaN or infinity counts as failed."""
    if not signs.finite.all():
        end = signs.time[signs.finite.argmin()]
        return {"kind": "failed", "reason": f"not finite from {end:.3g} s on"}
    gap = _worst(signs.gap)
    return _errors(scene, signs.error[None] * scene.length, truth) | {
        "gap_m": None if gap is None else gap * scene.length,
        "energy": _worst(signs.energy),
    }


def _errors(scene: Scene, error: Array, truth: Truth) -> dict[str, float]:
    """Return the finite ones of the error at the horizon and the growth-weighted one [m].

    `error` has shape (1, frame).
    """
    if truth.horizon == 0.0 or not truth.compared:
        return {}
    frame, known = round(truth.horizon / scene.clock.frame), truth.known
    (weighted,) = agreement.growth_weighted(error[:, known], truth.growth[:, known])
    figures = {"error_m": float(error[0, frame]), "error_weighted_m": float(weighted)}
    return {name: figure for name, figure in figures.items() if np.isfinite(figure)}


def _worst(series: Array) -> float | None:
    known = np.abs(series[np.isfinite(series)])
    return float(known.max()) if len(known) else None
