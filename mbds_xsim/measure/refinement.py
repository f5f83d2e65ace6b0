"""Runs at other steps, which show the limit to which an engine converges.

Three steps come first, the shortest of them no shorter than necessary. If they do not show how
the engine converges, the shortest one is halved, at most twice.
"""

from __future__ import annotations

from functools import partial

from mbds_xsim.base.isolate import Conduct, Task
from mbds_xsim.checks import Finding
from mbds_xsim.checks.consistency import Consistency
from mbds_xsim.checks.extrapolation import LEAST_SPAN
from mbds_xsim.measure.outcome import Outcome, ReferenceOutcome
from mbds_xsim.measure.runner import Account, Piece, carry_out
from mbds_xsim.reference import FirstImpact
from mbds_xsim.scene.collisions import has_known_impacts
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import rounding
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import simulate


def may_end(scene: Scene) -> bool:
    """Return whether the reference may end before the scene, so that other steps wait for it."""
    return bool(scene.contacts) and not has_known_impacts(Mechanism.of(scene))


def pieces_of(outcome: Outcome, reference: ReferenceOutcome | None = None) -> list[Piece]:
    """Return runs of an engine's sample at the other steps, as far as a known reference goes.

    The shortest step, which takes longest, comes first.
    """
    steps = other_steps(outcome.scene, outcome.contender)
    return [_step_piece(outcome, step, reference) for step in sorted(steps)]


def _step_piece(outcome: Outcome, step: float, reference: ReferenceOutcome | None) -> Piece:
    contender, sample = outcome.contender, outcome.batch[outcome.sample]
    settings = Settings(contender.settings.method, step, contender.settings.options)
    if reference is not None:
        sample = compared(sample, reference[outcome.sample])
    task = Task(simulate, (outcome.scene, sample, contender.engine, settings), contender.limit)
    keep = partial(outcome.keep_step, step)
    return Piece(step_name(contender, step), contender.engine, task, keep)


def step_name(contender: Contender, step: float) -> str:
    """Name the runs of an engine at a step [s]."""
    return f"{contender.name}, step {step:.3g} s"


def other_steps(scene: Scene, contender: Contender) -> list[float]:
    """Return the two other steps of the consistency check; the three halve one after another.

    Longer steps are used if they divide the frame, since they cost less; two per frame are only
    halved, since implicit methods that manage with two often fail with one. The list is empty for
    an adaptive method, which takes no step from its settings.
    """
    settings = contender.settings
    if load_adapter(contender.engine).methods[settings.method].adaptive:
        return []
    count = settings.substeps(scene.clock.frame)
    fewest = next(count // f for f in (4, 2, 1) if count % f == 0 and (count > 2 or f == 1))
    counts = (fewest, 2 * fewest, 4 * fewest)
    return [scene.clock.frame / each for each in counts if each != count]


_RUNS = 5
"""Largest number of steps compared; the shortest is then 1/16 of the longest."""
_PATIENCE = 300.0
"""Longest predicted time of a further run [s]."""


def convergence(outcome: Outcome, reference: ReferenceOutcome) -> list[Finding]:
    """Extrapolate the sample's runs at several steps to a vanishing step.

    Only smooth motion has an order of convergence: with contact, the motion before it.
    """
    consistency = _consistency_of(outcome, reference)
    return [] if consistency is None else consistency.findings


def further_step(outcome: Outcome, reference: ReferenceOutcome) -> float | None:
    """Return the next step at which the sample must run before convergence can be judged [s].

    None if no run is needed, if the engine fails anyway, or if the run would take too long.
    """
    if len(outcome.other_steps) + 1 >= _RUNS or outcome.failures:
        return None
    consistency = _consistency_of(outcome, reference)
    if consistency is None or not consistency.unsettled:
        return None
    step = outcome.contender.settings.step
    half = min(step, *outcome.other_steps) / 2.0
    simulated = sum(len(part.trajectory) for part in outcome.simulations)
    pace = sum(part.rollout_s for part in outcome.simulations) / simulated
    return half if pace * len(outcome.sample) * step / half < _PATIENCE else None


def compared(batch: Batch, reference: ReferenceOutcome) -> Batch:
    """Truncate a batch to the steps for which any of its trajectories has a reference."""
    ends = [batch.steps if e is None else e.frame for e in reference.trajectory.failures]
    return batch.truncated(max(1, *ends))


def refine(
    outcomes: list[Outcome], reference: ReferenceOutcome, conduct: Conduct, spent: Account
) -> None:
    """Run samples at further steps until they show how each engine converges."""
    while True:
        steps = [further_step(outcome, reference) for outcome in outcomes]
        runs = [(o, step) for o, step in zip(outcomes, steps, strict=True) if step is not None]
        if not runs:
            return
        conduct.meter.begin(len(runs))
        carry_out([_step_piece(*run, reference) for run in runs], conduct, spent)


def _consistency_of(outcome: Outcome, reference: ReferenceOutcome) -> Consistency | None:
    """Return the input of the consistency check; None if there is nothing to compare."""
    scene, method, is_smooth = outcome.scene, outcome.method, smooth(outcome.scene, reference)
    smooth_ones = [k for k, row in enumerate(outcome.sample) if is_smooth[row]]
    rows = [outcome.sample[k] for k in smooth_ones]
    truth = reference.trajectory
    trajectory = outcome.trajectory(truth.time)
    if trajectory is None or not rows or not outcome.other_steps:
        return None
    runs = {step: run[smooth_ones] for step, run in outcome.other_steps.items()}
    runs[outcome.contender.settings.step] = trajectory[rows]
    ordered = [runs[step] for step in sorted(runs, reverse=True)]
    growth = reference.growth[rows]
    floor = rounding.step_error(method, round(float(truth.time[-1]) / min(runs)))
    resolution = max(Consistency.resolution, floor)
    batch = outcome.batch[rows]
    return Consistency(scene, batch, ordered, truth[rows], method, growth, resolution, min(runs))


def smooth(scene: Scene, reference: ReferenceOutcome) -> list[bool]:
    """Return whether each trajectory begins with smooth motion that is long enough to be judged.

    The reference follows balls through impacts; with any other contact it ends at the first one.
    """
    ends = reference.trajectory.failures
    if not scene.contacts:
        return [True] * len(ends)
    balls = has_known_impacts(Mechanism.of(scene))
    return [
        not balls if end is None else isinstance(end, FirstImpact) and end.frame > LEAST_SPAN
        for end in ends
    ]
