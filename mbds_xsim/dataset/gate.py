"""Choice of the trajectories to publish: those that pass the checks.

A few of them are also compared with the reference, which would cost too much for all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np

from mbds_xsim import reference
from mbds_xsim.base.arrays import Index, Mask
from mbds_xsim.base.isolate import Crash
from mbds_xsim.checks import CHECKS, Finding, Record, agreement, audited
from mbds_xsim.checks.coefficients import evidence_of, shared_faults
from mbds_xsim.checks.extrapolation import LEAST_SPAN
from mbds_xsim.checks.record import EVERY_SECOND
from mbds_xsim.dataset.layout import INTEGRITY, sampled
from mbds_xsim.measure.campaign import RTOL, reference_of
from mbds_xsim.measure.judge import failed_lines, reference_findings
from mbds_xsim.measure.outcome import Outcome, ReferenceOutcome
from mbds_xsim.measure.refinement import compared, convergence, further_step, other_steps, smooth
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import Simulation, simulate

# The checks make many passes over arrays: pieces that stay in a core's cache are twice as fast,
# and bound the memory.
_BODY_FRAMES = 100_000

# Comparing displacements with velocities costs more than all other checks together. The fault it
# finds, frames that belong to another time, affects a whole trajectory, so few frames suffice.
_SPARSE = 96
_MANY = 192  # steps; in shorter trajectories all frames are compared

_BRIEF = LEAST_SPAN
"""Steps over which one trajectory of a shard without audit sample is compared with the reference;
all steps would cost as much as simulating a whole shard in the fastest engine."""
_GROWTH = 10.0
"""Sensitivity assumed over so few steps; it is at most 3 in the paper's scenes."""

TOGETHER = "together"
"""Prefix of a reason that only shows in several trajectories together."""

COLUMNS: dict[str, str] = {
    **{check.name: check.unit for check in CHECKS},
    "error at 1 s": "m",
    "error growth-weighted": "m",
    "error of turns": "rad",
}
"""Columns of the check table and their units: all checks, then the errors against the reference,
which are known for the audit sample only."""

_NUMBERS = {name: k for k, name in enumerate(COLUMNS)}


class CheckTable:
    """Results of the checks on some trajectories, as they are stored; there are none at first."""

    def __init__(self, count: int) -> None:
        shape = (count, len(COLUMNS))
        self.figure = np.full(shape, np.nan)
        """Worst figures, NaN where a check does not apply, shape (trajectory, check)."""
        self.allowed = np.full(shape, np.nan)
        """Largest allowed figures; ∞ if a figure is shown but not judged."""
        self.frame = np.full(shape, -1, dtype=np.int32)
        self.reasons: list[list[str]] = [[] for _ in range(count)]
        """Reasons why each trajectory fails, in the order of the checks."""
        self.failed = np.zeros(shape, dtype=bool)
        """Whether each check fails, shape (trajectory, check)."""
        self.ended = np.zeros(count, dtype=bool)
        """Whether the engine ended the trajectory early, so that it fails anyway; (trajectory,)."""
        self.misbuilt: list[str] = []
        """Faults of the engine's model as a whole: with any of them all trajectories are wrong."""

    def add(self, rows: Index, findings: Iterable[Finding]) -> None:
        """Store findings about some of the trajectories."""
        for finding in findings:
            column, applies = _NUMBERS[finding.check], finding.applies
            budget = np.inf if finding.budget is None else finding.budget
            self.figure[rows[applies], column] = finding.figure[applies]
            self.allowed[rows[applies], column] = budget + finding.uncertainty[applies]
            self.frame[rows[applies], column] = finding.frame[applies]
            self.failed[rows, column] = ~finding.passed
            for k in np.flatnonzero(~finding.passed):
                line = f"{finding.line(int(k))}, frame {finding.frame[k]}"
                self.reasons[rows[k]].append(line)

    def published(self, *, certified: bool) -> Mask:
        """Return which complete trajectories pass all checks, or only integrity if uncertified."""
        judged = list(COLUMNS) if certified else list(INTEGRITY)
        failed = self.failed[:, [_NUMBERS[name] for name in judged]].any(axis=1) | self.ended
        return np.asarray(~failed & (not (certified and self.misbuilt)))

    def reason(self, row: int) -> str:
        """Return the reasons why a trajectory fails, on one line."""
        return "; ".join([*self.misbuilt, *self.reasons[row]])


class Making(NamedTuple):
    """Facts that the checks need about how trajectories were made."""

    method: Method
    step: float
    """Integration step [s]."""
    contact_time: float
    """Time over which the engine spreads an impact [s]."""

    @staticmethod
    def of(contender: Contender) -> Making:
        """Return the facts that the engine's adapter declares."""
        adapter, settings = load_adapter(contender.engine), contender.settings
        time = adapter.contact_scales(settings).time
        return Making(adapter.methods[settings.method], settings.step, time)


def judge_rows(
    scene: Scene,
    batch: Batch,
    trajectory: Trajectory,
    making: Making,
    truth: ReferenceOutcome | None = None,
) -> CheckTable:
    """Check every trajectory; its figures depend only on the trajectory and its number.

    `truth` is the reference solution of the rows in the audit sample; it is solved here if None.
    """
    verdict = CheckTable(len(batch))
    for row, failure in enumerate(trajectory.failures):
        if failure is not None:
            verdict.ended[row] = True
            verdict.reasons[row].append(f"ended at frame {failure.frame}: {failure.reason}")
    evidence = []
    for group, rows, sound in _groups(scene, batch.index, trajectory):
        record = Record(
            scene,
            batch[_view(rows)],
            trajectory[_view(rows)],
            *making,
            _steps_compared(scene, group),
            many=sound and not Mechanism.of(scene).has_impacts,
        )
        verdict.add(rows, audited(record))
        # A blow-up may overflow on its way to infinity; the check `finite` reports it.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            evidence.append(evidence_of(record))
    verdict.misbuilt += [f"{TOGETHER}: {line}" for line in shared_faults(evidence)]
    rows = sampled(batch.index)
    if len(rows):
        solved = truth or reference_of(scene, batch[rows], False)
        verdict.add(rows, sample_findings(scene, batch[rows], trajectory[rows.tolist()], solved))
    return verdict


def _groups(
    scene: Scene, index: Index, trajectory: Trajectory
) -> Iterator[tuple[int, Index, bool]]:
    """Yield groups to check at once: group number, rows, and whether all numbers are finite."""
    size = max(1, _BODY_FRAMES // ((scene.clock.steps + 1) * len(scene.bodies)))
    sound = trajectory.finite
    for group in np.unique(index // size):
        for kind in (True, False):
            rows = np.flatnonzero((index // size == group) & (sound == kind))
            if len(rows):
                yield int(group), rows, kind


def _view(rows: Index) -> slice | list[int]:
    """Return consecutive rows as a slice, which copies nothing; other rows as a list."""
    first, last = int(rows[0]), int(rows[-1])
    return slice(first, last + 1) if last - first + 1 == len(rows) else rows.tolist()


def _steps_compared(scene: Scene, group: int) -> tuple[int, int]:
    """Return first step and stride: every 96th step, shifted so that groups cover all frames.

    In short trajectories every second step alone covers them.
    """
    if scene.clock.steps < _MANY:
        return EVERY_SECOND
    return 2 * (group % (_SPARSE // 2)), _SPARSE


def sample_findings(
    scene: Scene, batch: Batch, trajectory: Trajectory, solved: ReferenceOutcome
) -> list[Finding]:
    """Compare particles and turns with the reference, as `mbds-xsim validate` does.

    Stored solutions would save time, but would not be the same to the last bit.
    """
    truth = solved.trajectory
    error = agreement.particle_error(Mechanism.of(scene), trajectory, truth)
    return reference_findings(scene, batch, trajectory, error, truth, solved.growth)


def limit_faults(
    scene: Scene,
    contender: Contender,
    batch: Batch,
    trajectory: Trajectory,
    solved: ReferenceOutcome | None,
) -> list[str]:
    """List, one per line, where runs at other steps converge to anything but the reference.

    The trajectories must have reached their end. If their reference is None, only their first
    steps are compared, for which it is solved here.
    """
    rows, settings = list(range(len(batch))), contender.settings
    steps = other_steps(scene, contender)
    if steps and solved is None:
        scene, batch, trajectory = _beginning(scene, batch, trajectory)
        solved = _briefly(scene, batch)
    if solved is None or not steps or not any(smooth(scene, solved)):
        return []
    outcome = Outcome(contender, scene, batch, rows=[rows], sample=rows)
    brief = compared(batch, solved)

    def run(step: float) -> None:
        other = Settings(settings.method, step, settings.options)
        result = _made(scene, brief, contender.engine, other)
        outcome.keep_step(step, result)
        if isinstance(result, Crash):
            return
        rollout_s = result.rollout_s * step / settings.step * batch.steps / brief.steps
        outcome.parts[:] = [dataclasses.replace(result, trajectory=trajectory, rollout_s=rollout_s)]

    for step in steps:
        run(step)
    while (finer := further_step(outcome, solved)) is not None:
        run(finer)
    return failed_lines(batch, convergence(outcome, solved))


def _made(scene: Scene, batch: Batch, engine: str, settings: Settings) -> Simulation | Crash:
    """Run an engine at an additional step; if it cannot, the shard is not affected.

    The check then does without this run.
    """
    try:
        return simulate(scene, batch, engine, settings)
    except Exception as error:
        return Crash(f"{type(error).__name__}: {error}")


def _beginning(
    scene: Scene, batch: Batch, trajectory: Trajectory
) -> tuple[Scene, Batch, Trajectory]:
    """Return the first steps of trajectories, with a scene that ends after them."""
    steps = min(_BRIEF, batch.steps)
    clock = msgspec.structs.replace(scene.clock, steps=steps)
    states = {key: getattr(trajectory, key)[:, : steps + 1] for key in STATES}
    brief = dataclasses.replace(trajectory, time=trajectory.time[: steps + 1], **states)
    return msgspec.structs.replace(scene, clock=clock), batch.truncated(steps), brief


def _briefly(scene: Scene, batch: Batch) -> ReferenceOutcome:
    truth = reference.solve(scene, batch, rtol=RTOL, cache=False)
    growth = np.full(truth.position.shape[:2], _GROWTH)
    return ReferenceOutcome(truth, growth, RTOL, 0, 0.0)  # nothing asks how long
