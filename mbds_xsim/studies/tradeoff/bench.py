"""Where points of a chart are measured: one start at one setting, timed and held to the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.isolate import Crash
from mbds_xsim.checks import Finding, agreement, audit
from mbds_xsim.measure.identity import machine, row_key
from mbds_xsim.measure.judge import error_findings
from mbds_xsim.measure.runner import Meter, Runner, StudyCase, in_time
from mbds_xsim.measure.store import Store
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.simulator import Signs, Simulated, Simulator
from mbds_xsim.studies.tradeoff.rows import Measurement
from mbds_xsim.studies.tradeoff.truths import Place, Truth, Truths

_GRACE = 30.0
"""What a case may take beside its rollouts [s]."""
_PATIENCE = 3.0
"""A case may take so many times the limit of a rollout: predictions err, and machines stall."""


@dataclass(frozen=True)
class Job:
    """One start at one setting."""

    simulator: Simulator
    count: int
    """Steps a frame."""
    start: int
    """Row of the batch."""

    @property
    def place(self) -> Place:
        """What decides the truth it is held against."""
        return self.simulator.engine, self.simulator.method, self.start


@dataclass
class StartBench:
    """The starts of a study with what is true of them, and the runner of their jobs."""

    scene: Scene
    batch: Batch
    truths: Truths
    seed: int
    limit: float
    """Longest rollout of one start [s]."""
    runner: Runner[Measurement]

    @staticmethod
    def of(
        scene: Scene,
        batch: Batch,
        truths: Truths,
        *,
        seed: int,
        limit: float,
        fresh: bool,
        meter: Meter,
    ) -> StartBench:
        """Make a bench with the scene's store."""
        runner = Runner(
            store=Store.of("tradeoff", scene.name, Measurement),
            crashed=_crashed,
            labels=("scene", "variation", "trajectory", "seed"),
            lasts=in_time,
            workers=truths.workers,
            fresh=fresh,
            meter=meter,
            forecasts=False,
        )
        return StartBench(scene, batch, truths, seed, limit, runner)

    def rows(self, jobs: Sequence[Job]) -> list[Measurement]:
        """Give the row of each job, measuring those that are not kept."""
        cases = [self._case(job) for job in jobs]
        missing = {case.row.key for case in self.runner.missing(cases)}
        pairs = zip(jobs, cases, strict=True)
        self.truths.prepare([job.place for job, case in pairs if case.row.key in missing])
        return self.runner.rows(cases)

    def too_slow(self, simulator: Simulator, count: int, predicted: float) -> Measurement:
        """Give the row of a point that is not worth waiting for."""
        reason = f"predicted {predicted:.0f} s a start, limit {self.limit:g} s"
        row = self._bare(Job(simulator, count, 0))
        return msgspec.structs.replace(row, key="", kind="too slow", reason=reason)

    def _case(self, job: Job) -> StudyCase[Measurement]:
        start, simulator = self.batch[[job.start]], job.simulator
        return StudyCase(
            row=self._bare(job),
            name=simulator.name,
            function=measure,
            arguments=lambda: (
                simulator, self.scene, start, job.count, self.truths.of(job.place),
            ),
            limit=_PATIENCE * self.limit + _GRACE,
            group=simulator.source or None,
        )  # fmt: skip

    def _bare(self, job: Job) -> Measurement:
        """Give a row without figures."""
        simulator = job.simulator
        return Measurement(
            key=row_key(self.scene, self.batch[[job.start]], simulator, job.count),
            scene=self.scene.name,
            engine=simulator.engine,
            version=simulator.version,
            method=simulator.method,
            variation=simulator.variation,
            options=simulator.options(self.scene),
            steps_per_frame=job.count,
            step_s=self.scene.clock.frame / job.count,
            trajectory=int(self.batch.index[job.start]),
            seed=self.seed,
            machine=machine(),
            limit_s=self.limit,
            kind="done",
            horizon_s=self.truths.horizon,
        )


def _crashed(row: Measurement, crash: Crash) -> Measurement:
    return msgspec.structs.replace(row, kind=crash.kind, reason=" ".join(crash.reason.split()))


def measure(
    simulator: Simulator, scene: Scene, start: Batch, count: int, truth: Truth
) -> dict[str, Any]:
    """Simulate one start in this process, and give the figures of its row.

    Args:
        simulator: What simulates.
        scene: What is simulated.
        start: A batch of one.
        count: Steps a frame.
        truth: What the motion is held against.

    Raises:
        InputError: The simulator cannot do the scene or the settings are not allowed.
    """
    ran = simulator.simulate(scene, start, count, truth.trajectory, often=True)
    figures = (
        _of_particles(scene, ran.motion, truth)
        if isinstance(ran.motion, Signs)
        else _of_bodies(scene, start, ran.motion, ran, truth)
    )
    return {
        "wall_s": tuple(wall / ran.simulated_s for wall in ran.wall_s),
        "cpu_s": tuple(cpu / ran.simulated_s for cpu in ran.cpu_s),
        "setup_s": ran.setup_s,
        **({} if ran.size is None else vars(ran.size)),
        **figures,
    }


def _of_bodies(
    scene: Scene, start: Batch, motion: Trajectory, ran: Simulated, truth: Truth
) -> dict[str, Any]:
    """Judge a motion by all checks, and by its distance to the truth."""
    failure = motion.failures[0]
    if failure is not None:
        reason = " ".join(f"frame {failure.frame}: {failure.reason}".split())
        return {"kind": "failed", "reason": reason}
    error = agreement.particle_error(Mechanism.of(scene), motion, truth.trajectory)
    errors = _errors(scene, error, truth)
    checked = audit(scene, start, motion, ran.method, step=ran.step, contact_time=ran.contact_time)
    found = {finding.check: finding for finding in checked}
    if errors and truth.judged:
        checked = [*error_findings(scene, start, error, truth.trajectory, truth.growth), *checked]
    return errors | {
        "gap_m": _figure(found, "gap"),
        "energy": _figure(found, "passivity" if scene.contacts else "energy"),
        "broken": tuple(one.check for one in checked if not one.passed.all()),
    }


def _of_particles(scene: Scene, signs: Signs, truth: Truth) -> dict[str, Any]:
    """Judge a motion of particles by what they show; one that is lost has failed."""
    if not signs.finite.all():
        lost = signs.time[signs.finite.argmin()]
        return {"kind": "failed", "reason": f"not finite from {lost:.3g} s on"}
    gap = _worst(signs.gap)
    return _errors(scene, signs.error[None] * scene.length, truth) | {
        "gap_m": None if gap is None else gap * scene.length,
        "energy": _worst(signs.energy),
    }


def _errors(scene: Scene, error: Array, truth: Truth) -> dict[str, float]:
    """Give the error at the horizon and the growth-weighted one [m], of shape (1, frame)."""
    frame = round(truth.horizon / scene.clock.frame)
    if frame == 0:
        return {}
    known = truth.known
    (weighted,) = agreement.growth_weighted(error[:, known], truth.growth[:, known])
    return {"error_m": float(error[0, frame]), "error_weighted_m": float(weighted)}


def _figure(findings: dict[str, Finding], check: str) -> float | None:
    """Worst figure of a check, None where it does not apply or has none."""
    figure = float(findings[check].figure[0]) if check in findings else np.nan
    return figure if np.isfinite(figure) else None


def _worst(series: Array) -> float | None:
    known = np.abs(series[np.isfinite(series)])
    return float(known.max()) if len(known) else None
