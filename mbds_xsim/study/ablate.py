"""No more than a scene needs: what each modelled effect is worth beside engines' disagreement."""

from __future__ import annotations

import dataclasses
import os
import platform
import time
from dataclasses import dataclass

import numpy as np

from mbds_xsim import reference
from mbds_xsim.assembly import Start, check_joints
from mbds_xsim.campaign import ProgressSink
from mbds_xsim.checks import agreement
from mbds_xsim.choice import Choice, Contender
from mbds_xsim.engine import ModelSize
from mbds_xsim.errors import InputError, SceneError
from mbds_xsim.isolate import Crash, Task, run_tasks
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.reference import FirstImpact
from mbds_xsim.result import EngineResult, Evidence, Validation
from mbds_xsim.sampling import draw_batch
from mbds_xsim.scene import Scene
from mbds_xsim.simulate import simulate
from mbds_xsim.state import Batch, Trajectory
from mbds_xsim.study.ablate_effects import EFFECTS, Effect
from mbds_xsim.study.ablate_floor import Window, disagreement, floor_of, window_of
from mbds_xsim.study.ablate_result import Ablation, Floor, Row
from mbds_xsim.study.ablate_size import compared, least_size, native_size
from mbds_xsim.study.ablate_verdict import impossible, row_of
from mbds_xsim.validate import validate_with_evidence

__all__ = ["ablate"]

_TIMEOUT = 600.0  # of one ablated scene, all its starts [s]


def ablate(
    scene: Scene,
    *,
    choice: Choice | None = None,
    starts: int = 2,
    seed: int = 0,
    cache: bool = True,
    workers: int | None = None,
    progress: ProgressSink | None = None,
    command: str = "mbds_xsim.study.ablate.ablate",
) -> Ablation:
    """Drop and halve each effect of a scene and hold the change of motion to the floor.

    Args:
        scene: What to take apart.
        choice: Engines and settings that give the floor; all at matched settings when left out.
        starts: Starts of each of the intervals low, medium and high.
        seed: Seed of starts and inputs.
        cache: Whether stored reference solutions may be used.
        workers: Processes at a time; all cores when left out, none but this one for 0.
        progress: Where progress is told.
        command: What is told to make the study again.

    Raises:
        InputError: Something that was given cannot be used, or no engine delivered anything.
    """
    begin = time.perf_counter()
    chosen = choice or Choice.parse()
    meter = _Phases(progress)
    validation, evidence = validate_with_evidence(
        scene,
        choice=chosen,
        trajectories=starts,
        seed=seed,
        cache=cache,
        workers=workers,
        progress=meter,
    )
    bench = _Bench.of(validation, evidence, chosen)
    rows = bench.rows(_variants(scene, evidence.batch, seed), workers, cache, meter)
    least = least_size(scene)
    contenders, _ = chosen.contenders(scene)
    loads = [Task(native_size, (scene, c.engine, c.settings)) for c in contenders]
    sizes = run_tasks(loads, workers=workers)
    return Ablation(
        scene=scene.name,
        description=scene.description,
        judge=bench.judge_name,
        judged_s=(float(bench.window.spans.min()), float(bench.window.spans.max())),
        ends=bench.window.ends,
        duration_s=scene.clock.duration,
        length_m=scene.length,
        floor=bench.floor,
        floor_engines=bench.floor_engines,
        failed={r.engine: r.reasons[0] for r in validation.engines if r.verdict == "fail"},
        left_out=validation.left_out,
        rows=tuple(rows),
        degrees_of_freedom=least.degrees_of_freedom,
        joint_coordinates=least.coordinates,
        loop_conditions=least.conditions,
        contact_spheres=least.spheres,
        sizes=tuple(
            compared(contender.engine, size, least)
            for contender, size in zip(contenders, sizes, strict=True)
            if isinstance(size, ModelSize)
        ),
        trajectories=validation.trajectories,
        seed=seed,
        versions=validation.versions,
        machine=f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
        command=command,
        wall_s=time.perf_counter() - begin,
    )


class _Phases:
    """Tells the progress of one piece of work after another as one."""

    def __init__(self, progress: ProgressSink | None) -> None:
        self._progress = progress
        self._before = 0

    def begin(self, total: int) -> None:
        self._before += total
        if self._progress is not None:
            self._progress.begin(self._before)

    def advance(self, what: str) -> None:
        if self._progress is not None:
            self._progress.advance(what)


@dataclass(frozen=True, eq=False)
class _Variant:
    """An effect made weaker: the scene and its starts, or why there are none."""

    effect: Effect
    factor: float
    scene: Scene
    batch: Batch
    reason: str = ""


def _variants(scene: Scene, batch: Batch, seed: int) -> list[_Variant]:
    found = []
    for effect in EFFECTS:
        for factor in effect.factors:
            try:
                ablated = effect.weaken(scene, factor)
                if ablated is None:
                    continue
                starts = (
                    draw_batch(ablated, batch.index, seed=seed)
                    if effect.starts == "redrawn"
                    else _kept(scene, ablated, batch)
                )
            except SceneError as error:
                reason = str(error).removeprefix("sampling: ").split(", allowed")[0]
                found.append(_Variant(effect, factor, scene, batch, reason))
            else:
                found.append(_Variant(effect, factor, ablated, starts))
    return found


def _kept(scene: Scene, ablated: Scene, batch: Batch) -> Batch:
    """Give the full scene's starts and inputs to the ablated one; raise where joints forbid it."""
    mechanism, other = Mechanism.of(scene), Mechanism.of(ablated)
    native = mechanism.native_rotation(batch.orientation)
    check_joints(other, Start(batch.position, native, batch.velocity, batch.angular_velocity))
    torque = np.zeros((len(batch), batch.steps, len(other.hinges)))
    columns = {joint.name: k for k, joint in enumerate(mechanism.hinges)}
    for k, joint in enumerate(other.hinges):
        if joint.name in columns:
            torque[:, :, k] = batch.torque[:, :, columns[joint.name]]
    return dataclasses.replace(batch, torque=torque)


@dataclass(frozen=True, eq=False)
class _Bench:
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
    def of(validation: Validation, evidence: Evidence, choice: Choice) -> _Bench:
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
            contenders, _ = choice.contenders(evidence.scene)
            judge = next(c for c in contenders if c.engine == best.engine)
            name = f"{best.engine}, {best.method}, step {best.step_s:g} s"
        return _Bench(
            scene=evidence.scene,
            judge=judge,
            judge_name=name,
            full=full,
            window=window,
            floor=floor_of(evidence.scene, window, apart),
            floor_engines=tuple(r.engine for r in voters),
        )

    def rows(
        self, variants: list[_Variant], workers: int | None, cache: bool, meter: ProgressSink
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

    def _task(self, variant: _Variant, cache: bool) -> Task:
        if self.judge is None:
            return Task(_solved, (variant.scene, variant.batch, cache), _TIMEOUT)
        batch = variant.batch.truncated(max(self.window.frames - 1, 1))
        return Task(_simulated, (variant.scene, batch, self.judge), _TIMEOUT)

    def _row(self, variant: _Variant, answer: Trajectory | Crash | None) -> Row:
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
