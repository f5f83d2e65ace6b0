"""Where the points of a study are measured: isolated, timed out, kept, and told about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec

from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.measure.identity import machine, row_key
from mbds_xsim.measure.store import Store
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.studies.tradeoff.point import INSTANT, Measured, horizon_of, measure
from mbds_xsim.studies.tradeoff.rows import Kind, Row
from mbds_xsim.studies.tradeoff.sweep import Curve
from mbds_xsim.studies.tradeoff.truths import Place, Truths

_GRACE = 30.0
"""What a task may take beside its rollouts [s]."""
_PATIENCE = 3.0
"""A task may take so many times the limit of a rollout: predictions err, and machines stall."""


class Meter(Protocol):
    """Where progress is told."""

    def forecast(self, left_s: float) -> None:
        """Say how much work is left [s of one worker]."""

    def advance(self, what: str) -> None:
        """Count one point as measured."""


@dataclass(frozen=True)
class Job:
    """One start at one setting."""

    curve: Curve
    count: int
    """Steps a frame."""
    start: int
    """Row of the batch."""

    @property
    def place(self) -> Place:
        """What decides the truth it is held against."""
        return self.curve.engine, self.curve.method, self.start


@dataclass
class Bench:
    """Measures jobs, or takes their rows from the store."""

    scene: Scene
    batch: Batch
    truths: Truths
    seed: int
    limit: float
    """Longest rollout of one start [s]."""
    workers: int | None
    store: Store[Row]
    meter: Meter
    measured: int = 0
    kept: int = 0
    fresh: bool = False
    """Whether what the store holds from earlier is measured again."""
    _now: set[str] = field(default_factory=set)

    def rows(self, jobs: Sequence[Job]) -> list[Row]:
        """Give the row of each job, measuring those that are not kept."""
        keys = [self._key(job) for job in jobs]
        found = [self._kept(key, job) for key, job in zip(keys, jobs, strict=True)]
        missing = [place for place, row in enumerate(found) if row is None]

        def finished(order: int, answer: Any) -> None:
            place = missing[order]
            row = self._row(keys[place], jobs[place], answer)
            found[place] = row
            self.store.add(row)
            self._now.add(row.key)
            self.measured += 1
            self.meter.advance(jobs[place].curve.name)

        self.truths.prepare([jobs[place].place for place in missing])
        tasks = [self._task(jobs[place]) for place in missing]
        run_tasks(tasks, workers=self.workers, finished=finished)
        return [row for row in found if row is not None]

    def too_slow(self, curve: Curve, count: int, predicted: float) -> Row:
        """Give the row of a point that is not worth waiting for."""
        reason = f"predicted {predicted:.0f} s a start, limit {self.limit:g} s"
        return self._bare(Job(curve, count, 0), "", "too slow", reason)

    @property
    def horizon(self) -> float:
        """Time of the charted error, the earliest of all starts [s]."""
        if self.truths.are_limits:
            return min(INSTANT, self.scene.clock.duration)
        return min(horizon_of(truth.trajectory) for truth in self.truths.references)

    def _key(self, job: Job) -> str:
        settings = job.curve.settings(self.scene, job.count)
        return row_key(self.scene, self.batch[[job.start]], job.curve.engine, settings)

    def _kept(self, key: str, job: Job) -> Row | None:
        """Take a row from the store; one that ran out of time only if it had as much."""
        row = self.store.rows.get(key)
        if row is None or (self.fresh and key not in self._now):
            return None
        if row.kind == "timed out" and row.limit_s < self.limit:
            return None
        self.kept += key not in self._now
        return msgspec.structs.replace(
            row,
            scene=self.scene.name,
            variation=job.curve.variation,
            trajectory=int(self.batch.index[job.start]),
            seed=self.seed,
        )

    def _task(self, job: Job) -> Task:
        settings: Settings = job.curve.settings(self.scene, job.count)
        start = self.batch[[job.start]]
        arguments = (self.scene, start, job.curve.engine, settings, self.truths.of(job.place))
        return Task(measure, arguments, _PATIENCE * self.limit + _GRACE)

    def _row(self, key: str, job: Job, answer: Measured | Crash) -> Row:
        if isinstance(answer, Crash):
            kind: Kind = "refused" if answer.refused else "crashed"
            return self._bare(job, key, "timed out" if answer.timed_out else kind, answer.reason)
        failure = answer.failure
        reason = "" if failure is None else f"frame {failure.frame}: {failure.reason}"
        bare = self._bare(job, key, "failed" if failure else "done", reason)
        return msgspec.structs.replace(
            bare,
            wall_s=answer.timing.wall_s,
            cpu_s=answer.timing.cpu_s,
            setup_s=answer.timing.setup_s,
            error_m=answer.error_m,
            error_weighted_m=answer.error_weighted_m,
            gap_m=answer.gap_m,
            energy=answer.energy,
            broken=answer.broken,
            coordinates=answer.size.coordinates,
            constraints=answer.size.constraints,
            contact_pairs=answer.size.contact_pairs,
        )

    def _bare(self, job: Job, key: str, kind: Kind, reason: str) -> Row:
        """Give a row without figures."""
        curve = job.curve
        return Row(
            key=key,
            scene=self.scene.name,
            engine=curve.engine,
            version=registry.load_adapter(curve.engine).version(),
            method=curve.method,
            variation=curve.variation,
            options=dict(curve.options),
            steps_per_frame=job.count,
            step_s=self.scene.clock.frame / job.count,
            trajectory=int(self.batch.index[job.start]),
            seed=self.seed,
            machine=machine(),
            limit_s=self.limit,
            kind=kind,
            reason=" ".join(reason.split()),
            horizon_s=self.horizon,
        )
