"""One trial of a search: some starts at one setting, judged as `validate` judges.

On the ground it must keep the limits of contact too, which are narrower than the budgets. Where
nothing is known of the motion, it must at least be near its own limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.isolate import Crash
from mbds_xsim.checks import Finding, agreement
from mbds_xsim.measure.campaign import Outcome, ReferenceOutcome, other_steps
from mbds_xsim.measure.contact import contact_findings
from mbds_xsim.measure.convergence import further_step
from mbds_xsim.measure.judge import Judged, failed_lines, finding_result, judge
from mbds_xsim.measure.result import EngineResult
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.timed import simulate

_WARM_UP = 2  # frames


@dataclass(frozen=True)
class Trial:
    """How a setting did."""

    reasons: tuple[str, ...]
    """One line for each thing that failed; none: it passed."""
    excess: float
    """Largest figure over its budget; infinite where a trajectory or the process was lost."""
    cpu_s: float
    """Processor time per simulated second."""
    wall_s: float
    """Wall time per simulated second."""
    error_1s_m: float | None = None
    error_weighted_m: float | None = None
    gap_m: float | None = None
    energy: float | None = None
    trajectories: int = 0

    @property
    def passed(self) -> bool:
        """Whether all budgets are kept."""
        return not self.reasons

    @property
    def broken(self) -> int:
        """Number of checks that fail."""
        return len({reason.partition(":")[0] for reason in self.reasons})


def run_trial(
    scene: Scene,
    batch: Batch,
    engine: str,
    settings: Settings,
    reference: ReferenceOutcome,
    sample: int,
) -> Trial:
    """Simulate a batch in this process and judge it.

    Args:
        scene: What to simulate.
        batch: Starts and inputs.
        engine: Name of the adapter.
        settings: How to step.
        reference: Solution of the batch.
        sample: Trajectories that run at other steps too, for the check of consistency.
    """
    simulate(scene, batch[:1].truncated(_WARM_UP), engine, settings)
    outcome = Outcome(Contender(engine, "matched", settings), rows=[list(range(len(batch)))])
    simulation = simulate(scene, batch, engine, settings)
    outcome.parts.append(simulation)
    row, limits = _judged(scene, batch, outcome, reference)
    # Where it fails already, nothing that other steps tell can mend it.
    if sample and _passed(row, limits):
        outcome.sample = list(range(min(sample, len(batch))))
        steps: list[float] = other_steps(scene, settings)
        while steps:
            for step in steps:
                other = Settings(settings.method, step, settings.options)
                run = simulate(scene, batch[outcome.sample], engine, other)
                outcome.keep_step(step, batch, run)
            further = further_step(scene, batch, outcome, reference)
            steps = [] if further is None else [further]
        row, limits = _judged(scene, batch, outcome, reference)
        if row.trajectory is not None and is_unknown(reference):
            runs = outcome.other_steps
            limits += [own_limit(scene, row.trajectory, settings.step, outcome.sample, runs)]
    result, simulated = row.result, len(batch) * scene.clock.duration
    return Trial(
        reasons=(*result.reasons, *failed_lines(batch, limits)),
        excess=math.inf if result.failures else _excess(batch, result, limits),
        cpu_s=simulation.cpu_s / simulated,
        wall_s=simulation.rollout_s / simulated,
        error_1s_m=result.error_1s_m,
        error_weighted_m=result.error_weighted_m,
        gap_m=result.constraint_gap_m,
        energy=result.energy_balance,
        trajectories=len(batch),
    )


def failed_trial(crash: Crash) -> Trial:
    """Give the trial of a process that left no answer."""
    return Trial((crash.reason,), math.inf, math.inf, math.inf)


def joined(parts: Sequence[Trial]) -> Trial:
    """Put the parts of one setting's trajectories together: worst figures, mean times."""
    counts = [part.trajectories for part in parts]

    def mean(times: list[float]) -> float:
        # Where a process was lost, there is no time.
        return float(np.average(times, weights=counts)) if all(counts) else math.inf

    figures = {}
    for name in ("error_1s_m", "error_weighted_m", "gap_m", "energy"):
        values = [getattr(part, name) for part in parts]
        figures[name] = max((value for value in values if value is not None), default=None)
    return Trial(
        reasons=tuple(reason for part in parts for reason in part.reasons),
        excess=max(part.excess for part in parts),
        cpu_s=mean([part.cpu_s for part in parts]),
        wall_s=mean([part.wall_s for part in parts]),
        trajectories=sum(counts),
        **figures,
    )


def _judged(
    scene: Scene, batch: Batch, outcome: Outcome, reference: ReferenceOutcome
) -> tuple[Judged, list[Finding]]:
    """Judge as `validate` does, and by the limits of contact."""
    row, contender = judge(scene, batch, outcome, reference), outcome.contender
    if row.trajectory is None:
        return row, []
    method = registry.load_adapter(contender.engine).methods[contender.settings.method]
    momentum = row.series.get("momentum")
    return row, contact_findings(scene, row.trajectory, reference, method, momentum)


def _passed(row: Judged, limits: Sequence[Finding]) -> bool:
    return not row.result.reasons and all(limit.passed.all() for limit in limits)


def _excess(batch: Batch, result: EngineResult, limits: Sequence[Finding]) -> float:
    findings = [*result.findings, *(finding_result(batch, limit) for limit in limits)]
    judged = [f for f in findings if f.budget]
    ratios = [f.figure / f.budget if f.budget else 0.0 for f in judged]
    return max((r if math.isfinite(r) else math.inf for r in ratios), default=0.0)


# How far a motion is from its method's own limit, where there is no motion to hold it against.
#
# To be near it says nothing of the truth: engines converge to different motions where contact has
# no unique solution. To be far from it is to be wrong whatever is true.

_INSTANT = 1.0  # of the budget [s]


def is_unknown(reference: ReferenceOutcome) -> bool:
    """Whether nothing is known of a motion after its start."""
    return not np.isfinite(reference.trajectory.position[:, 1:]).all(axis=(2, 3)).any()


def own_limit(
    scene: Scene,
    motion: Trajectory,
    step: float,
    sample: Sequence[int],
    others: Mapping[float, Trajectory],
) -> Finding:
    """Extrapolate a motion at 1 s, or its end before that, to a vanishing step.

    Contact makes every method one of the first order: with steps h and k·h the error of the longer
    one is k / (k − 1) times their distance, that of the shorter one 1 / (k − 1) times. The nearest
    shorter step is taken, or where there is none the nearest longer one.

    Args:
        scene: What was simulated.
        motion: At the step in question.
        step: That step [s].
        sample: Rows of the motion that ran at other steps too.
        others: The sample by step [s].

    Returns:
        RMS distance of the particles [m], against the scene's budget of the error at 1 s; 0 for
        rows beside the sample.
    """
    shorter = max((h for h in others if h < step), default=None)
    other = min(others) if shorter is None else shorter
    ratio = max(step, other) / min(step, other)
    apart = agreement.particle_error(Mechanism.of(scene), motion[list(sample)], others[other])
    share = apart * (1.0 if shorter is None else ratio) / (ratio - 1.0)
    frame = min(round(_INSTANT / scene.clock.frame), share.shape[1] - 1)
    series = np.full((*motion.position.shape[:2], 1), np.nan)
    series[:, frame] = 0.0
    series[list(sample), frame, 0] = np.where(np.isfinite(share), share, np.inf)[:, frame]
    budget = scene.budget.error_1s * scene.length
    return Finding.of("distance to its own limit", "m", series, budget=budget)
