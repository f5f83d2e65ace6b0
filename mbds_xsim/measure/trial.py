"""One trial of a search: some starts at one setting, judged as by `validate`.

On the ground it must also meet the limits of contact, which are narrower than the budgets. If
nothing is known of the true motion, it must at least be close to its own limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.base.isolate import Crash
from mbds_xsim.checks import Finding, agreement
from mbds_xsim.measure.judge import Judged, failed_lines, judge
from mbds_xsim.measure.outcome import Outcome, ReferenceOutcome
from mbds_xsim.measure.refinement import further_step, other_steps
from mbds_xsim.measure.result import FIGURES
from mbds_xsim.scene.collisions import has_known_impacts
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.timed import WARM_UP, simulate


@dataclass(frozen=True)
class Trial:
    """Result of trying a setting."""

    reasons: tuple[str, ...]
    """One line for each failure; empty if it passed."""
    excess: float
    """Largest `share` of a budget; infinite if a trajectory or the process was lost."""
    cpu_s: float
    """Processor time per simulated second."""
    wall_s: float
    """Wall time per simulated second."""
    figures: Mapping[str, float | None] = field(default_factory=lambda: dict.fromkeys(FIGURES))
    """Accuracy figures by name."""
    trajectories: int = 0

    @property
    def passed(self) -> bool:
        """Whether all budgets are met."""
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

    The first `sample` trajectories also run at other steps, for the check of consistency.
    """
    simulate(scene, batch[:1].truncated(WARM_UP), engine, settings)
    rows, contender = [list(range(len(batch)))], Contender(engine, "matched", settings)
    outcome = Outcome(contender, scene, batch, rows=rows)
    simulation = simulate(scene, batch, engine, settings)
    outcome.parts.append(simulation)
    row, limits = _judge_all(outcome, reference)
    # If it already fails, other steps cannot change the verdict.
    passed = not row.result.reasons and all(limit.passed.all() for limit in limits)
    if sample and passed:
        outcome.sample = list(range(min(sample, len(batch))))
        steps = other_steps(scene, contender)
        while steps:
            for step in steps:
                other = Settings(settings.method, step, settings.options)
                run = simulate(scene, batch[outcome.sample], engine, other)
                outcome.keep_step(step, run)
            further = further_step(outcome, reference)
            steps = [] if further is None else [further]
        row, limits = _judge_all(outcome, reference)
        if row.trajectory is not None and outcome.other_steps and is_unknown(reference):
            limits.append(own_limit(outcome, row.trajectory))
    result, simulated = row.result, len(batch) * scene.clock.duration
    return Trial(
        reasons=(*result.reasons, *failed_lines(batch, limits)),
        excess=math.inf if result.failures else _excess([*row.findings, *limits]),
        cpu_s=simulation.cpu_s / simulated,
        wall_s=simulation.rollout_s / simulated,
        figures={name: getattr(result, name) for name in FIGURES},
        trajectories=len(batch),
    )


def failed_trial(crash: Crash) -> Trial:
    """Return the trial of a process that left no answer."""
    return Trial((crash.reason,), math.inf, math.inf, math.inf)


def joined(parts: Sequence[Trial]) -> Trial:
    """Put the parts of one setting's trajectories together: worst figures, mean times."""
    counts = [part.trajectories for part in parts]

    def mean(times: list[float]) -> float:
        # A process that was lost has no time.
        return float(np.average(times, weights=counts)) if all(counts) else math.inf

    figures = {}
    for name in FIGURES:
        values = [part.figures[name] for part in parts]
        figures[name] = max((value for value in values if value is not None), default=None)
    return Trial(
        reasons=tuple(reason for part in parts for reason in part.reasons),
        excess=max(part.excess for part in parts),
        cpu_s=mean([part.cpu_s for part in parts]),
        wall_s=mean([part.wall_s for part in parts]),
        figures=figures,
        trajectories=sum(counts),
    )


def _judge_all(outcome: Outcome, reference: ReferenceOutcome) -> tuple[Judged, list[Finding]]:
    """Judge as `validate` does, and also by the limits of contact."""
    row = judge(outcome, reference)
    if row.trajectory is None:
        return row, []
    scene, method, momentum = outcome.scene, outcome.method, row.series.get("momentum")
    return row, contact_findings(scene, row.trajectory, reference, method, momentum)


def _excess(findings: Sequence[Finding]) -> float:
    return max((finding.share for finding in findings if finding.budget), default=0.0)


# Distance of a motion from its method's own limit, if there is no true motion to compare it with.
#
# A small distance says nothing about the truth: engines converge to different motions if contact
# has no unique solution. A large distance is an error whatever the truth.


def is_unknown(reference: ReferenceOutcome) -> bool:
    """Return whether no trajectory has a known motion after its start."""
    return not np.isfinite(reference.trajectory.position[:, 1:]).all(axis=(2, 3)).any()


def own_limit(outcome: Outcome, motion: Trajectory) -> Finding:
    """Estimate the distance of a motion from its limit of vanishing step, at 1 s or an earlier end.

    Contact makes every method one of first order: with steps h and k·h, the error of the longer
    one is k / (k − 1) times their distance, that of the shorter one 1 / (k − 1) times. The next
    shorter step is used or, if there is none, the next longer one.

    Returns:
        RMS distance of the particles [m], with the scene's budget for the error at 1 s; 0 for rows
        outside the sample, which did not run at other steps.
    """
    scene, sample, others = outcome.scene, outcome.sample, outcome.other_steps
    step = outcome.contender.settings.step
    shorter = max((h for h in others if h < step), default=None)
    other = min(others) if shorter is None else shorter
    ratio = max(step, other) / min(step, other)
    distance = agreement.particle_error(Mechanism.of(scene), motion[sample], others[other])
    share = distance * (1.0 if shorter is None else ratio) / (ratio - 1.0)
    frame = min(agreement.second(scene.clock.frame), share.shape[1] - 1)
    series = np.full((*motion.position.shape[:2], 1), np.nan)
    series[:, frame] = 0.0
    series[sample, frame, 0] = np.where(np.isfinite(share), share, np.inf)[:, frame]
    budget = scene.budget.error_1s * scene.length
    return Finding.of("distance to its own limit", "m", series, budget=budget)


# Contact accuracy against the exact motion, if there is one: limits in addition to the budgets.
#
# Budgets bound errors weighted by the growth of small differences. The limits of contact are
# narrower, and hold piece by piece: while a ball slides, until it first hits the ground, to the
# top of its first rebound, up to its third bounce; and in flight, for bodies that are joined.

_SLIDING = 2e-3  # relative to the scene's length, like other position errors
_FALLING = 5e-4
_BOUNCING = 2e-2
_BOUNCES = 3
_REBOUND = 2e-2
_LOWEST_REBOUND = 0.25  # relative to the height of the fall: lower ones count as that high
_FLYING = 1.25e-3
_TURNING = 1e-3  # [rad]
_MOMENTUM = 1e-3  # relative to the check's scale
_MOMENTUM_HIGH_ORDER = 1e-6
_HIGH_ORDER = 4
_CALM = 2.0  # growth up to which errors in flight are the method's own


def contact_findings(
    scene: Scene,
    motion: Trajectory,
    exact: ReferenceOutcome,
    method: Method,
    momentum: Array | None,
) -> list[Finding]:
    """Compare a motion on the ground with the pieces of it that are known exactly.

    A ball's motion is known throughout, that of joined bodies up to the first impact. Errors are
    distances of centres of mass; bodies that start in contact and are no balls have none. Momentum,
    the series of its check (trajectory, frame) if there is one, is checked in all flights.

    Returns:
        A finding for each limit that applies; none where the scene has no ground, or no gravity
        towards it.
    """
    if scene.ground is None or scene.gravity[2] >= 0.0:
        return []
    mechanism = Mechanism.of(scene)
    pieces = _ball_pieces if has_known_impacts(mechanism) else _flight_pieces
    return [*pieces(mechanism, motion, exact), *_momenta(exact, method, momentum)]


def _ball_pieces(
    mechanism: Mechanism, motion: Trajectory, exact: ReferenceOutcome
) -> Iterator[Finding]:
    length, error = mechanism.scene.length, _distance(motion, exact.trajectory)
    bounces = _bounces(mechanism, exact.trajectory)
    hopping = np.broadcast_to((bounces > 0).any(axis=1, keepdims=True), bounces.shape)
    between = (bounces > 0) & (bounces < _BOUNCES)
    yield from _finding("error while sliding", "m", error, ~hopping, _SLIDING * length)
    before = hopping & (bounces == 0)
    yield from _finding("error before the first impact", "m", error, before, _FALLING * length)
    rebound, tops = _rebounds(mechanism, motion, exact.trajectory, bounces)
    yield from _finding("height of the first rebound", "1", rebound, tops, _REBOUND)
    yield from _finding("error up to the third bounce", "m", error, between, _BOUNCING * length)


def _flight_pieces(
    mechanism: Mechanism, motion: Trajectory, exact: ReferenceOutcome
) -> Iterator[Finding]:
    truth = exact.trajectory
    flying = truth.known & (exact.growth < _CALM)
    flying &= flying[:, 1:].any(axis=1, keepdims=True)  # else it starts in contact
    turn = rotation.multiply(motion.orientation, rotation.conjugate(truth.orientation))
    angle = 2.0 * np.arcsin(np.minimum(1.0, np.linalg.norm(turn[..., 1:], axis=-1)))
    in_flight = np.broadcast_to(flying[:, :, None], angle.shape)
    limit = _FLYING * mechanism.scene.length
    yield from _finding("error in flight", "m", _distance(motion, truth), in_flight, limit)
    yield from _finding("turn in flight", "rad", angle, in_flight, _TURNING)


def _momenta(exact: ReferenceOutcome, method: Method, momentum: Array | None) -> Iterator[Finding]:
    """Yield findings on momentum; before impact, high-order methods keep it almost to rounding."""
    if momentum is None:
        return
    series = momentum[:, :, None]
    high = method.order >= _HIGH_ORDER
    known = exact.trajectory.known
    before = known & ~known.all(axis=1, keepdims=True)
    before &= before[:, 1:].any(axis=1, keepdims=True)
    budget = _MOMENTUM_HIGH_ORDER if high else _MOMENTUM
    check = "momentum before the first impact"
    yield from _finding(check, "1", series, (before & ~np.isnan(momentum))[:, :, None], budget)
    yield from _finding("momentum in flight", "1", series, ~np.isnan(series), _MOMENTUM)


def _finding(check: str, unit: str, value: Array, where: Mask, budget: float) -> Iterator[Finding]:
    """Yield a finding on values (trajectory, frame, part) where they count; nothing if nowhere.

    Values there that are not finite become infinite. A trajectory without values that count has
    the figure 0.
    """
    if not where.any():
        return
    figure = np.where(where, np.where(np.isfinite(value), value, np.inf), np.nan)
    figure[~where.any(axis=(1, 2)), 0] = 0.0
    yield Finding.of(check, unit, figure, budget=budget)


def _distance(motion: Trajectory, exact: Trajectory) -> Array:
    """Return distances of centres of mass [m], shape (trajectory, frame, body)."""
    return np.asarray(np.linalg.norm(motion.position - exact.position, axis=-1))


def _bounces(mechanism: Mechanism, exact: Trajectory) -> Index:
    """Count each ball's bounces so far as upward velocity jumps, (trajectory, frame, body)."""
    climb = exact.velocity[..., 2]
    lift = -0.5 * mechanism.scene.gravity[2] * mechanism.scene.clock.frame
    return np.cumsum(np.diff(climb, axis=1, prepend=climb[:, :1]) > lift, axis=1)


def _rebounds(
    mechanism: Mechanism, motion: Trajectory, exact: Trajectory, bounces: Index
) -> tuple[Array, Mask]:
    """Compare heights of the first rebounds, extrapolated from the frame nearest to the top.

    Returns:
        Relative errors and a mask of these frames, each of shape (trajectory, frame, body).
    """
    radius = np.empty(mechanism.body_count)
    radius[mechanism.sphere_body] = mechanism.sphere_radius
    pull = -mechanism.scene.gravity[2]
    speed = np.where(bounces == 1, np.abs(exact.velocity[..., 2]), np.inf)
    nearest = speed.argmin(axis=1)[:, None]
    tops = np.zeros(speed.shape, dtype=bool)
    np.put_along_axis(tops, nearest, np.isfinite(speed.min(axis=1))[:, None], axis=1)
    height, exact_height = (
        run.position[..., 2] - radius + run.velocity[..., 2] ** 2 / (2 * pull)
        for run in (motion, exact)
    )
    scale = np.maximum(exact_height, _LOWEST_REBOUND * exact_height[:, :1])
    return np.abs(height - exact_height) / np.where(tops, scale, 1.0), tops
