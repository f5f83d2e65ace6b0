"""No more than a scene needs: what each modelled effect is worth beside engines' disagreement."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence

from mbds_xsim.campaign import Watch
from mbds_xsim.choice import Choice, Contender
from mbds_xsim.counted import counted
from mbds_xsim.engine import ModelSize
from mbds_xsim.isolate import Task, run_tasks
from mbds_xsim.result import Validation
from mbds_xsim.scene import Scene
from mbds_xsim.silence import Silent
from mbds_xsim.study.ablate_bench import Bench
from mbds_xsim.study.ablate_effects import EFFECTS, Effect
from mbds_xsim.study.ablate_result import Ablation, Row, Size
from mbds_xsim.study.ablate_size import Least, compared, least_size, native_size
from mbds_xsim.study.ablate_variants import variants_of
from mbds_xsim.study.quick import searched
from mbds_xsim.validation import validate_with_evidence

__all__ = ["ablate"]


def ablate(
    scene: Scene,
    *,
    choice: Choice | None = None,
    effects: Sequence[Effect] = EFFECTS,
    starts: int = 2,
    seed: int = 0,
    cache: bool = True,
    workers: int | None = None,
    progress: Watch | None = None,
    command: str = "mbds_xsim.study.ablate.ablate",
) -> Ablation:
    """Drop and halve each effect of a scene and hold the change of motion to the floor.

    Args:
        scene: What to take apart.
        choice: Engines and settings that give the floor; all at matched settings when left out.
        effects: What may be dropped; those that the scene does not have are passed over.
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
    meter = _Phases(progress)
    chosen = searched(scene, choice or Choice.parse(), cache=cache, workers=workers, progress=meter)
    validation, evidence = validate_with_evidence(
        scene,
        choice=chosen,
        trajectories=starts,
        seed=seed,
        cache=cache,
        workers=workers,
        progress=meter,
    )
    contenders, _ = chosen.contenders(scene)
    bench = Bench.of(validation, evidence, contenders)
    variants = variants_of(scene, effects, evidence.batch, seed)
    rows = bench.rows(variants, workers, cache, meter)
    sizes = _sizes(scene, contenders, least_size(scene), workers)
    return _result(scene, validation, bench, rows, sizes, command, time.perf_counter() - begin)


def _sizes(
    scene: Scene, contenders: Sequence[Contender], least: Least, workers: int | None
) -> tuple[Size, ...]:
    tasks = [Task(native_size, (scene, c.engine, c.settings)) for c in contenders]
    return tuple(
        compared(contender.engine, size, least)
        for contender, size in zip(contenders, run_tasks(tasks, workers=workers), strict=True)
        if isinstance(size, ModelSize)
    )


def _result(
    scene: Scene,
    validation: Validation,
    bench: Bench,
    rows: Sequence[Row],
    sizes: tuple[Size, ...],
    command: str,
    wall_s: float,
) -> Ablation:
    window, least = bench.window, least_size(scene)
    return Ablation(
        scene=scene.name,
        description=scene.description,
        judge=bench.judge_name,
        judged_s=(float(window.spans.min()), float(window.spans.max())),
        ends=window.ends,
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
        sizes=sizes,
        trajectories=validation.trajectories,
        seed=validation.seed,
        versions=validation.versions,
        machine=f"{platform.machine()}, {counted(os.cpu_count(), 'core')}, {platform.system()}",
        command=command,
        wall_s=wall_s,
    )


class _Phases:
    """Tells the progress of one piece of work after another as one."""

    def __init__(self, progress: Watch | None) -> None:
        watch: Watch = progress or Silent()
        self._begin, self._before = watch.begin, 0
        self.advance, self.doing, self.notice = watch.advance, watch.doing, watch.notice

    def begin(self, total: int) -> None:
        self._before += total
        self._begin(self._before)
