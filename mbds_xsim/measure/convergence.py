"""The runs of the consistency check: at which steps, and what they say.

Three steps come first, the shortest of them no shorter than need be. Where they do not show how
the engine converges, the shortest one is halved, twice at most.
"""

from __future__ import annotations

from mbds_xsim.base.isolate import run_tasks
from mbds_xsim.checks import Finding
from mbds_xsim.checks.consistency import LEAST_SPAN, Consistency
from mbds_xsim.measure.campaign import Outcome, ReferenceOutcome, Running, Watch, step_task
from mbds_xsim.reference import FirstImpact
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure
from mbds_xsim.simulate import registry

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
) -> None:
    """Run samples at further steps until they show how each engine converges."""
    while True:
        steps = [further_step(scene, batch, outcome, reference) for outcome in outcomes]
        asked = [(o, step) for o, step in zip(outcomes, steps, strict=True) if step is not None]
        if not asked:
            return
        progress.begin(len(asked))
        names = [f"{o.contender.name}, step {step:.3g} s" for o, step in asked]
        tasks = [step_task(scene, batch, outcome, step) for outcome, step in asked]
        now = Running(progress, names)
        answers = run_tasks(tasks, workers=workers, started=now.started, finished=now.finished)
        for (outcome, step), answer in zip(asked, answers, strict=True):
            outcome.keep_step(step, batch, answer)


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
    method = registry.load_adapter(contender.engine).methods[contender.settings.method]
    ordered = [runs[step] for step in sorted(runs, reverse=True)]
    growth = reference.growth[rows]
    return Consistency(scene, batch[rows], ordered, truth[rows], method, growth)


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
