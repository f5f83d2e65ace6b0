"""Judgement of an engine's outcome: figures, verdict and reasons of its row of the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks import CHECKS, Finding, Record, agreement, audited
from mbds_xsim.checks.conservation import energy_balance
from mbds_xsim.checks.eccentric import impact_coefficients
from mbds_xsim.checks.integrity import gap
from mbds_xsim.measure.outcome import Outcome, ReferenceOutcome
from mbds_xsim.measure.refinement import convergence
from mbds_xsim.measure.result import EngineResult, FindingResult, ReferenceResult
from mbds_xsim.reference import FirstImpact
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.claims import RTOL
from mbds_xsim.simulate.registry import load_adapter


@dataclass(frozen=True, eq=False)
class Judged:
    """An engine's result and the underlying arrays."""

    result: EngineResult
    trajectory: Trajectory | None
    error: Array | None
    """RMS particle error [m], shape (trajectory, frame); None for the reference itself."""
    findings: Sequence[Finding] = ()

    @property
    def series(self) -> dict[str, Array]:
        """Series of the findings, by check."""
        return {finding.check: finding.series for finding in self.findings}


def judge(outcome: Outcome, reference: ReferenceOutcome, *, native: bool = True) -> Judged:
    """Check an engine's outcome and return its result with the verdict.

    Without `native`, only the motion is judged, not the native model that was read back.
    """
    scene, batch, truth = outcome.scene, outcome.batch, reference.trajectory
    trajectory = outcome.trajectory(truth.time)
    if trajectory is None:
        return Judged(_result(outcome, [], None, reference, native), None, None)
    step, method = outcome.contender.settings.step, outcome.method
    spread = outcome.simulations[0].contact_time
    record = Record(scene, batch, trajectory, method, step, spread)
    findings, error = audited(record, (*CHECKS, impact_coefficients)), None
    if not method.is_truth:
        error = agreement.particle_error(Mechanism.of(scene), trajectory, truth)
        findings += [
            *reference_findings(scene, batch, trajectory, error, truth, reference.growth),
            *convergence(outcome, reference),
        ]
    result = _result(outcome, findings, error, reference, native)
    return Judged(result, trajectory, error, findings)


def reference_result(scene: Scene, batch: Batch, reference: ReferenceOutcome) -> ReferenceResult:
    """Check the reference's joint gap and energy balance, and return them with its cost."""
    record = Record(scene, batch, reference.trajectory)
    findings = {finding.check: finding for finding in audited(record, (gap, energy_balance))}
    return ReferenceResult(
        rtol=reference.rtol,
        constraint_gap_m=worst_of(findings, "gap") or 0.0,
        energy_balance=worst_of(findings, "energy") or 0.0,
        cached=reference.cached,
        wall_s=reference.busy_s,
        known_s=tuple(
            end.time if isinstance(end, FirstImpact) else None
            for end in reference.trajectory.failures
        ),
    )


def reference_findings(
    scene: Scene,
    batch: Batch,
    trajectory: Trajectory,
    error: Array,
    truth: Trajectory,
    growth: Array,
) -> list[Finding]:
    """Compare a motion with the reference's: its error, of `particle_error`, and its rotations."""
    turns = turn_finding(scene, trajectory.orientation, truth, growth)
    return [*error_findings(scene, batch, error, truth, growth), turns]


def error_findings(
    scene: Scene, batch: Batch, error: Array, truth: Trajectory, growth: Array
) -> list[Finding]:
    """Compare the error with its budgets: unweighted at 1 s, and growth-weighted at all times."""
    known = truth.known
    figure = np.where(np.isfinite(error), error, np.inf)
    judged = known & (growth < agreement.CHAOS)
    findings = [
        Finding.of(
            "error growth-weighted",
            "m",
            np.where(judged, figure / np.maximum(1.0, growth), np.nan)[:, :, None],
            budget=scene.budget.error * scene.length,
        )
    ]
    at_one = known & (np.arange(len(truth.time)) == agreement.second(scene.clock.frame))
    calm = batch.regular & at_one.any(axis=1)
    if calm.any():
        finding = Finding.of(
            "error at 1 s",
            "m",
            np.where(at_one, figure, np.nan)[calm][:, :, None],
            budget=scene.budget.error_1s * scene.length,
        )
        findings.insert(0, finding.among(calm))
    return findings


def turn_finding(scene: Scene, orientation: Array, truth: Trajectory, growth: Array) -> Finding:
    """Compare bodies' rotations with the reference's, since a small part moves no particle far.

    `orientation` has unit quaternions (wxyz), shape (trajectory, frame, body, 4).
    """
    turn = rotation.multiply(rotation.conjugate(truth.orientation), orientation)
    angle = 2.0 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0]))
    weighted = np.where(np.isfinite(angle), angle, np.inf) / np.maximum(1.0, growth)[..., None]
    judged = truth.known & (growth < agreement.CHAOS)
    return Finding.of(
        "error of turns",
        "rad",
        np.where(judged[..., None], weighted, np.nan),
        budget=scene.budget.error_turn,
        names=tuple(body.name for body in scene.bodies),
    )


def _result(
    outcome: Outcome,
    findings: list[Finding],
    error: Array | None,
    reference: ReferenceOutcome,
    native: bool,
) -> EngineResult:
    contender, simulations, method = outcome.contender, outcome.simulations, outcome.method
    scene, batch, adapter = outcome.scene, outcome.batch, load_adapter(contender.engine)
    by_name = {finding.check: finding for finding in findings}
    failures = tuple(outcome.failures)
    differences = _readback_differences(outcome) if native else []
    reasons = (*failures, *differences, *failed_lines(batch, findings))
    ends = [end for s in simulations for end in s.trajectory.failures]
    frames = sum(batch.steps if end is None else min(end.frame, batch.steps) for end in ends)
    simulated = float(frames * scene.clock.frame)
    size = simulations[0].size if simulations else None
    return EngineResult(
        engine=contender.engine,
        version=adapter.version(),
        profile=contender.profile,
        method=method.name,
        family=method.family,
        order=method.order_for(scene),
        step_s=contender.settings.step,
        options=dict(contender.settings.options),
        verdict="fail" if reasons else "pass",
        reasons=reasons,
        error_1s_m=worst_of(by_name, "error at 1 s"),
        error_max_m=None if error is None else _finite(np.nanmax(error, initial=-np.inf)),
        error_weighted_m=worst_of(by_name, "error growth-weighted"),
        constraint_gap_m=worst_of(by_name, "gap"),
        energy_balance=worst_of(by_name, "energy"),
        agreement_time_s=None if error is None else _agreed(scene, error, reference.trajectory),
        wall_per_simulated_s=sum(s.rollout_s for s in simulations) / simulated
        if simulated
        else None,
        setup_s=float(np.median([s.setup_s for s in simulations])) if simulations else None,
        coordinates=size.coordinates if size else None,
        constraints=size.constraints if size else None,
        findings=tuple(finding_result(batch, finding) for finding in findings),
        failures=failures,
        rtol=adapter.option(contender.settings, RTOL) if method.adaptive else None,
    )


def _agreed(scene: Scene, error: Array, truth: Trajectory) -> float | None:
    """Return the first time at which an error passes 1 % of the scene's length [s], or None."""
    known = np.where(truth.known, error, 0.0)
    return _finite(agreement.agreement_time(known, truth.time, scene.length).min())


def _readback_differences(outcome: Outcome) -> list[str]:
    if outcome.contender.profile != "matched":
        return []
    mechanism, settings = Mechanism.of(outcome.scene), outcome.contender.settings
    for rows, part in outcome.ran:
        batch = outcome.batch[rows]
        lines = readback.compare(mechanism, batch, settings, part.readback, outcome.method)
        if lines:
            return [f"read-back: {line}" for line in lines]
    return []


def failed_lines(batch: Batch, findings: list[Finding]) -> list[str]:
    """Return one line for each check that failed, naming the worst trajectory."""
    lines = []
    for finding in findings:
        if not finding.passed.all():
            row = finding.worst
            lines.append(f"{finding.line(row)}, {batch.label(row)}, frame {finding.frame[row]}")
    return lines


def finding_result(batch: Batch, finding: Finding) -> FindingResult:
    """Convert a finding to the form in which it is written."""
    row = finding.worst
    return FindingResult(
        check=finding.check,
        unit=finding.unit,
        figure=float(finding.figure[row]),
        budget=finding.budget,
        passed=bool(finding.passed.all()),
        trajectory=int(batch.index[row]),
        frame=int(finding.frame[row]),
        where=finding.where[row],
        figures=tuple(_finite(figure) for figure in finding.figure),
        note=finding.note,
    )


def worst_of(findings: dict[str, Finding], check: str) -> float | None:
    """Return the worst figure of a check; None if it does not apply or is not finite."""
    if check not in findings:
        return None
    finding = findings[check]
    return _finite(float(np.max(finding.figure[finding.applies])))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
