"""The main study: run a scene in all engines, check every trajectory, reach a verdict."""

from __future__ import annotations

import functools
import operator
import time
from collections.abc import Mapping

import numpy as np

from mbds_xsim.base.isolate import USUAL, Conduct
from mbds_xsim.checks import agreement
from mbds_xsim.measure.campaign import run_campaign
from mbds_xsim.measure.judge import Judged, judge, reference_result
from mbds_xsim.measure.outcome import Outcome, ReferenceOutcome
from mbds_xsim.measure.quick import searched
from mbds_xsim.measure.refinement import further_step, refine
from mbds_xsim.measure.result import SCHEMA, EnsembleResult, Evidence, ReferenceResult, Validation
from mbds_xsim.measure.runner import Account, machine, versions_of
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import Starts
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory, fingerprint
from mbds_xsim.simulate.choice import Choice, Contender
from mbds_xsim.simulate.claims import TRUTH

_ONE_SECOND = 1.0
_LEAST_TIME = 0.01  # shorter work is left out of the account [s]
_STARTS = Starts()
_VERDICTS = ("pass", "warn", "fail")  # the worst last


def validate_with_evidence(
    scene: Scene,
    *,
    choice: Choice,
    starts: Starts = _STARTS,
    conduct: Conduct = USUAL,
    readback: bool = True,
    search: bool = True,
    command: str = "",
) -> tuple[Validation, Evidence]:
    """Validate a scene, and keep the arrays for a page. See `mbds_xsim.validate`.

    Without `readback` the verdict is on the motion alone, not on the engine's native model. Without
    `search` the choice is used as it is, after a search that the caller made.
    """
    begin, spent = time.perf_counter(), Account(float)
    chosen = searched(scene, choice, conduct) if search else choice
    if chosen.settings != choice.settings:
        spent["search of settings"] = time.perf_counter() - begin
    contenders, left_out = chosen.contenders(scene)
    batch = starts.draw(scene)
    rows, reference, checked = _judge(scene, batch, contenders, conduct, spent, native=readback)
    voting = time.perf_counter()
    results, times = [row.result for row in rows], reference.trajectory.time
    runs, families = _runs(rows, reference)
    matrix, odd = _vote(scene, batch, runs, families)
    ensembles = _ensembles(scene, batch, runs)
    spent["checks"] += time.perf_counter() - voting
    validation = Validation(
        schema=SCHEMA,
        scene=scene.name,
        description=scene.description,
        verdict=max((one.verdict for one in results), key=_VERDICTS.index, default="pass"),
        wall_s=time.perf_counter() - begin,
        command=command,
        seed=starts.seed,
        trajectories=tuple(int(index) for index in batch.index),
        length_m=scene.length,
        budget={key: getattr(scene.budget, key) for key in scene.budget.__struct_fields__},
        engines=tuple(results),
        left_out=left_out,
        reference=checked,
        names=tuple(runs),
        matrix_m=matrix,
        matrix_s=float(times[_instant(scene)]),
        odd_one_out=odd,
        versions=versions_of({result.engine: result.version for result in results}),
        machine=machine(),
        ensembles=ensembles,
        spent_s=_account(spent),
        fingerprint=fingerprint(scene),
    )
    return validation, Evidence(
        scene=scene,
        batch=batch,
        trajectories=tuple(row.trajectory for row in rows),
        reference=reference.trajectory,
        growth=reference.growth,
        errors=tuple(row.error for row in rows),
        series=tuple(row.series for row in rows),
    )


def _judge(
    scene: Scene,
    batch: Batch,
    contenders: list[Contender],
    conduct: Conduct,
    spent: Account,
    *,
    native: bool,
) -> tuple[list[Judged], ReferenceOutcome, ReferenceResult]:
    """Run the engines, and judge each as soon as possible, while others still run."""
    judged: dict[str, Judged] = {}
    checked_reference = functools.cache(functools.partial(reference_result, scene, batch))

    def check(outcome: Outcome, reference: ReferenceOutcome) -> None:
        checking, name = time.perf_counter(), outcome.contender.name
        conduct.meter.doing(f"{name}: checks")
        checked_reference(reference)
        if further_step(outcome, reference) is None:
            judged[name] = judge(outcome, reference, native=native)
        spent["checks"] += time.perf_counter() - checking

    outcomes, reference = run_campaign(scene, batch, contenders, conduct, spent, then=check)
    remaining = [outcome for outcome in outcomes if outcome.contender.name not in judged]
    refine(remaining, reference, conduct, spent)
    for outcome in remaining:
        check(outcome, reference)
    rows = [judged[outcome.contender.name] for outcome in outcomes]
    return rows, reference, checked_reference(reference)


def _account(spent: Account) -> dict[str, float]:
    """List the time spent on each kind of work, the longest first [s]."""
    longest = sorted(spent.items(), key=operator.itemgetter(1), reverse=True)
    return {work: seconds for work, seconds in longest if seconds >= _LEAST_TIME}


def _runs(
    rows: list[Judged], reference: ReferenceOutcome
) -> tuple[dict[str, Trajectory], tuple[str, ...]]:
    """Return motions keyed by engine and settings, and their method families.

    The reference comes last, and once only, even if it also takes part as an engine.
    """
    runs, families = {}, []
    for row in rows:
        if row.result.family != TRUTH and row.trajectory is not None:
            runs[f"{row.result.engine} {row.result.profile}"] = row.trajectory
            families.append(row.result.family)
    return {**runs, "reference": reference.trajectory}, (*families, "reference")


def _vote(
    scene: Scene, batch: Batch, runs: Mapping[str, Trajectory], families: tuple[str, ...]
) -> tuple[tuple[tuple[float, ...], ...], str | None]:
    """Compare all pairs of runs, the reference last, at 1 s on low and medium starts."""
    names, mechanism = tuple(runs), Mechanism.of(scene)
    regular = [run[batch.regular] for run in runs.values()]
    matrix = agreement.pairwise(mechanism, regular, _instant(scene))
    allowed = scene.budget.error_1s * scene.length
    # Past a first impact no solution is unique, and sound engines may stand apart.
    unique = np.isfinite(matrix[-1, :-1]).any()
    odd = agreement.odd_one_out(matrix, families, tolerance=allowed) if unique else ()
    odd_names = ", ".join(names[k] for k in odd) or None
    return tuple(tuple(float(x) for x in line) for line in matrix), odd_names


def _instant(scene: Scene) -> int:
    """Return the frame at which runs are compared: the one that stands for 1 s, or the last."""
    return min(agreement.second(scene.clock.frame), scene.clock.steps)


def _ensembles(
    scene: Scene, batch: Batch, runs: Mapping[str, Trajectory]
) -> tuple[EnsembleResult, ...]:
    """Compare distributions at the end, for runs whose motions no longer agree one by one."""
    names, comparisons = tuple(runs), agreement.compare_runs(scene, batch, tuple(runs.values()))
    return tuple(
        EnsembleResult(names[a], names[b], scene.clock.duration, c.distance, c.p_value, c.count)
        for (a, b), c in comparisons.items()
    )
