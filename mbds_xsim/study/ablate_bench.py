"""Where ablated scenes are simulated and judged: by the reference or the best engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim import reference
from mbds_xsim.campaign import ProgressSink
from mbds_xsim.checks import agreement
from mbds_xsim.choice import Contender
from mbds_xsim.errors import InputError
from mbds_xsim.isolate import Crash, Task, run_tasks
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.reference import FirstImpact
from mbds_xsim.result import EngineResult, Evidence, Validation
from mbds_xsim.scene import Scene
from mbds_xsim.simulate import simulate
from mbds_xsim.state import Batch, Trajectory
from mbds_xsim.study.ablate_floor import Window, disagreement, floor_of, window_of
from mbds_xsim.study.ablate_result import Floor, Row
from mbds_xsim.study.ablate_variants import Variant
from mbds_xsim.study.ablate_verdict import impossible, row_of

__all__ = ["Bench"]

_TIMEOUT = 600.0  # of one ablated scene, all its starts [s]


@dataclass(frozen=True, eq=False)
class Bench:
    """What simulates ablated scenes, the full scene's motion in it, and the floor."""

    scene: Scene
    judge: Contender | None
    """None: the reference."""
    judge_name: str
    full: Trajectory
    window: Window
    floor: Floor
    floor_engines: tuple[str, ...]

    @staticmethod
    def of(validation: Validation, evidence: Evidence, contenders: Sequence[Contender]) -> Bench:
        """Choose the judge by what engines delivered on the full scene."""
        runs = {
            result.engine: run
            for result, run in zip(validation.engines, evidence.trajectories, strict=True)
            if run is not None
        }
        passed = [r for r in validation.engines if r.verdict != "fail" and r.engine in runs]
        voters = [r for r in validation.engines if r.engine in runs] if len(passed) < 2 else passed
        if not voters:
            msg = f"{evidence.scene.name}: no engine delivered a motion; nothing can be compared"
            raise InputError(msg)
        apart = disagreement(evidence.scene, [runs[r.engine] for r in voters])
        window = window_of(evidence, apart)
        judge, full, name = None, evidence.reference, "the reference"
        if not np.isfinite(evidence.reference.position).all():
            best = min(voters, key=_inaccuracy)
            full = runs[best.engine]
            judge = next(c for c in contenders if c.engine == best.engine)
            name = f"{best.engine}, {best.method}, step {best.step_s:g} s"
        return Bench(
            scene=evidence.scene,
            judge=judge,
            judge_name=name,
            full=full,
            window=window,
            floor=floor_of(evidence.scene, window, apart),
            floor_engines=tuple(r.engine for r in voters),
        )

    def rows(
        self, variants: list[Variant], workers: int | None, cache: bool, meter: ProgressSink
    ) -> list[Row]:
        """Simulate all variants and judge them."""
        able = [variant for variant in variants if not variant.reason]
        meter.begin(len(able))
        answers = run_tasks(
            [self._task(variant, cache) for variant in able],
            workers=workers,
            finished=lambda place, _: meter.advance(f"without {able[place].effect.name}"),
        )
        told = dict(zip(map(id, able), answers, strict=True))
        return [self._row(variant, told.get(id(variant))) for variant in variants]

    def _task(self, variant: Variant, cache: bool) -> Task:
        if self.judge is None:
            return Task(_solved, (variant.scene, variant.batch, cache), _TIMEOUT)
        batch = variant.batch.truncated(max(self.window.frames - 1, 1))
        return Task(_simulated, (variant.scene, batch, self.judge), self.judge.limit)

    def _row(self, variant: Variant, answer: Trajectory | Crash | None) -> Row:
        effect, factor = variant.effect, variant.factor
        if answer is None or isinstance(answer, Crash):
            reason = variant.reason if answer is None else answer.reason
            return impossible(effect, factor, reason)
        change = agreement.particle_error(Mechanism.of(self.scene), answer, self.full)
        whole = np.full(self.window.judged.shape, np.nan)
        whole[:, : change.shape[1]] = change
        return row_of(effect, factor, whole, self.window, self.floor, _lost(answer))


def _inaccuracy(result: EngineResult) -> tuple[bool, float]:
    """Rank engines: by their error where there is a reference, else by their worst check."""
    if result.error_weighted_m is not None and result.error_weighted_m > 0:
        return False, result.error_weighted_m
    judged = [finding for finding in result.findings if finding.budget]
    return True, max((f.figure / (f.budget or 1.0) for f in judged), default=np.inf)


def _solved(scene: Scene, batch: Batch, cache: bool) -> Trajectory:
    return reference.solve(scene, batch, cache=cache)


def _simulated(scene: Scene, batch: Batch, judge: Contender) -> Trajectory:
    return simulate(scene, batch, judge.engine, judge.settings).trajectory


def _lost(run: Trajectory) -> str:
    """Say which ablated runs ended early."""
    ends = [failure for failure in run.failures if failure is not None]
    if not ends:
        return ""
    impacts = all(isinstance(end, FirstImpact) for end in ends)
    what = "known up to the first impact only" if impacts else ends[0].reason
    return f"{len(ends)} of {len(run.failures)} starts: {what}"
