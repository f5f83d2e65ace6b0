"""Ablation of a scene: how much each modelled effect matters against engines' disagreement."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np

from mbds_xsim import reference
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import USUAL, Conduct, Crash, Task, run_tasks
from mbds_xsim.base.text import counted
from mbds_xsim.checks import agreement
from mbds_xsim.measure.quick import searched
from mbds_xsim.measure.result import EngineResult, Evidence, Validation
from mbds_xsim.reference import FirstImpact
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Block, Cell, Column, Mark, Remarks, Report, Row, table_of
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import Starts
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.choice import Choice, Contender
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.studies.ablate.analyse import (
    Ablation,
    Size,
    WeakenedEffect,
    disagreement,
    floor_of,
    least_size,
    row_of,
    sizes_of,
    window_of,
)
from mbds_xsim.studies.ablate.effects import EFFECTS, AblatedScene, Effect, variants_of
from mbds_xsim.studies.validate import validate_with_evidence

_STARTS = Starts(2)


def ablate(
    scene: Scene,
    *,
    choice: Choice | None = None,
    effects: Sequence[Effect] = EFFECTS,
    starts: Starts = _STARTS,
    conduct: Conduct = USUAL,
    command: str = "mbds_xsim.studies.ablate.ablate",
) -> Ablation:
    """Drop and halve each effect of a scene, and compare the change of motion with the floor.

    Args:
        scene: Scene to take apart.
        choice: Engines and settings that give the floor; by default all at matched settings.
        effects: Effects to drop; those that the scene does not have are skipped.
        starts: Starts to draw.
        conduct: How the work is carried out.
        command: Command to report for repeating the study.

    Raises:
        InputError: An argument cannot be used, or no engine delivered a motion.
    """
    begin = time.perf_counter()
    chosen = searched(scene, choice or Choice.parse(), conduct)
    validation, evidence = validate_with_evidence(
        scene, choice=chosen, starts=starts, conduct=conduct, search=False
    )
    contenders, _ = chosen.contenders(scene)
    bench, least = Bench(validation, evidence, contenders), least_size(scene)
    rows = bench.rows(variants_of(scene, effects, evidence.batch, starts.seed), conduct)
    sizes = sizes_of(scene, contenders, least, conduct.workers)
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
        **vars(least),
        sizes=tuple(sizes),
        trajectories=validation.trajectories,
        seed=validation.seed,
        versions=validation.versions,
        machine=validation.machine,
        command=command,
        wall_s=time.perf_counter() - begin,
    )


_TIMEOUT = 600.0  # for all starts of one ablated scene [s]


class Bench:
    """Judge that simulates ablated scenes, its motion of the full scene, and the floor.

    The judge is the reference, or the best engine if the reference ends early.
    """

    def __init__(
        self, validation: Validation, evidence: Evidence, contenders: Sequence[Contender]
    ) -> None:
        runs = {
            result.engine: run
            for result, run in zip(validation.engines, evidence.trajectories, strict=True)
            if run is not None
        }
        ran = [result for result in validation.engines if result.engine in runs]
        passed = [result for result in ran if result.verdict != "fail"]
        voters = ran if len(passed) < 2 else passed
        if not voters:
            msg = f"{evidence.scene.name}: no engine delivered a motion; nothing can be compared"
            raise InputError(msg)
        self.scene, self.floor_engines = evidence.scene, tuple(r.engine for r in voters)
        apart = disagreement(self.scene, [runs[engine] for engine in self.floor_engines])
        self.window = window_of(evidence, apart)
        self.floor = floor_of(self.scene, self.window)
        self.full, self.judge_name = evidence.reference, "the reference"
        self.judge: Contender | None = None  # the reference
        if not evidence.reference.known.all():
            best = min(voters, key=_inaccuracy)
            self.full = runs[best.engine]
            self.judge = next(c for c in contenders if c.engine == best.engine)
            self.judge_name = f"{best.engine}, {best.method}, step {best.step_s:g} s"

    def rows(self, variants: list[AblatedScene], conduct: Conduct) -> list[WeakenedEffect]:
        """Simulate all variants and judge them."""
        meter = conduct.meter
        possible = [variant for variant in variants if not variant.reason]
        meter.begin(len(possible))
        answers = run_tasks(
            [self._task(variant, conduct.cache) for variant in possible],
            workers=conduct.workers,
            finished=lambda place, _: meter.advance(f"without {possible[place].effect.name}"),
        )
        answer_by_id = dict(zip(map(id, possible), answers, strict=True))
        return [self._row(variant, answer_by_id.get(id(variant))) for variant in variants]

    def _task(self, variant: AblatedScene, cache: bool) -> Task:
        if self.judge is None:
            return Task(_solve, (variant.scene, variant.batch, cache), _TIMEOUT)
        batch = variant.batch.truncated(max(self.window.frames - 1, 1))
        return Task(_simulate, (variant.scene, batch, self.judge), self.judge.limit)

    def _row(self, variant: AblatedScene, answer: Trajectory | Crash | None) -> WeakenedEffect:
        effect, factor = variant.effect, variant.factor
        if answer is None or isinstance(answer, Crash):
            reason = variant.reason if answer is None else answer.reason
            return WeakenedEffect(effect.name, factor, effect.dropped, "not possible", reason)
        padded = answer.padded(self.full.time)
        change = agreement.particle_error(Mechanism.of(self.scene), padded, self.full)
        return row_of(effect, factor, change, self.window, self.floor, _describe_failures(answer))


def _inaccuracy(result: EngineResult) -> tuple[bool, float]:
    """Rank an engine by its error against the reference, or by its worst check without one."""
    if result.error_weighted_m is not None and result.error_weighted_m > 0:
        return False, result.error_weighted_m
    budgeted = [finding for finding in result.findings if finding.budget]
    return True, max((f.figure / (f.budget or 1.0) for f in budgeted), default=np.inf)


def _solve(scene: Scene, batch: Batch, cache: bool) -> Trajectory:
    return reference.solve(scene, batch, cache=cache)


def _simulate(scene: Scene, batch: Batch, judge: Contender) -> Trajectory:
    return simulate(scene, batch, judge.engine, judge.settings).trajectory


def _describe_failures(run: Trajectory) -> str:
    """Report how many ablated runs ended early, and why."""
    ends = [failure for failure in run.failures if failure is not None]
    if not ends:
        return ""
    impacts = all(isinstance(end, FirstImpact) for end in ends)
    cause = "known up to the first impact only" if impacts else ends[0].reason
    return f"{len(ends)} of {len(run.failures)} starts: {cause}"


_MARKS: dict[str, Mark] = {"needed": "strong", "not possible": "muted"}
_COLUMNS = (
    Column("effect", "what the scene models", words=True),
    Column("made", "dropped, or how much of it is left", words=True),
    Column("at 1 s", "RMS change of the particles at 1 s, worst of the low and medium starts"),
    Column("median", "the same, median of these starts", narrow=False),
    Column(
        "overall",
        "largest change over the whole comparison, divided by the growth of a disturbance, "
        "worst of all starts",
    ),
    Column("median ", "the same, median of all starts", narrow=False),
    Column("× floor", "the larger of the two changes over its floor"),
    Column(
        "× engines",
        "the larger of the two changes over the disagreement between engines alone",
        narrow=False,
    ),
    Column("verdict", "needed where a change is above its floor", words=True),
)


def present(ablation: Ablation) -> Report:
    """Report which effects the scene needs, and which floor their changes are compared with."""
    versions = ", ".join(f"{name} {version}" for name, version in ablation.versions.items())
    return Report(
        title=ablation.scene,
        what="what it needs",
        description=ablation.description,
        conclusion=_conclusion(ablation),
        blocks=tuple(_blocks(ablation)),
        command=ablation.command,
        made=f"{ablation.machine}, in {quantity.span(ablation.wall_s)}, with {versions}",
    )


def _blocks(ablation: Ablation) -> Iterator[Block]:
    yield table_of(_COLUMNS, map(_row, ablation.rows), grouped=True)
    yield Remarks.of(
        [
            ("judge", _judge(ablation)),
            ("floor", _floors(ablation)),
            *((f"{engine} failed", reason) for engine, reason in ablation.failed.items()),
            *((f"{engine} left out", reason) for engine, reason in ablation.left_out.items()),
        ]
    )
    headings = ("engine", ">coordinates", ">constraints", ">contact pairs", "")
    sizes = (
        (s.engine, str(s.coordinates), str(s.constraints), str(s.contact_pairs), _more(s))
        for s in ablation.sizes
    )
    yield table_of(headings, sizes)
    yield Remarks.of([("scene", _smallest(ablation))])


def _row(row: WeakenedEffect) -> Row:
    changes = (row.change_1s_m, row.change_1s_median_m, row.change_m, row.change_median_m)
    texts = (
        row.effect,
        "dropped" if row.factor == 0.0 else f"× {row.factor:g}",
        *map(quantity.length, changes),
        *map(quantity.number, (row.over_floor, row.over_disagreement)),
    )
    above = row.over_floor is not None and row.over_floor > 1.0
    # The sentence is left out where the figures explain the verdict.
    plain = row.verdict == ("needed" if above else "not needed") or not row.sentence
    verdict = Cell(row.verdict, _MARKS.get(row.verdict, ""))
    return Row((*map(Cell, texts), verdict), reasons=() if plain else (row.sentence,))


def _conclusion(ablation: Ablation) -> str:
    dropped = [row for row in ablation.rows if row.factor == 0.0]
    judged = dropped or ablation.rows  # those that are only halved say less
    names = [row.effect for row in judged if row.verdict == "not needed"]
    needed = sum(row.verdict == "needed" for row in judged)
    count = f"{needed} of {len(judged)} effects are needed{'' if dropped else ' in full'}"
    if not judged:
        return "it models no effect that could be dropped or halved"
    return f"{count}; not needed: {', '.join(names)}" if names else count


def _judge(ablation: Ablation) -> str:
    """Name the simulator of the scene with and without each effect, and the time compared."""
    low, high = (quantity.span(value) for value in ablation.judged_s)
    span = high if low == high else f"{low} to {high}"
    text = f"{ablation.judge}, {counted(len(ablation.trajectories), 'start')} compared over {span}"
    return f"{text}; then {ablation.ends}" if ablation.ends else text


def _floors(ablation: Ablation) -> str:
    """Report the floors that a change must exceed, and their origin."""
    floor = ablation.floor
    at_one = "none"
    if floor.disagreement_1s_m is not None:
        at_one = _floor(floor.at_1s, floor.disagreement_1s_m, floor.budget_1s_m)
    overall = _floor(floor.overall, floor.disagreement_m, floor.budget_m)
    return f"{at_one} at 1 s, {overall} overall; engines: {', '.join(ablation.floor_engines)}"


def _floor(floor: float, disagreement: float | None, budget: float) -> str:
    return (
        f"{quantity.length(floor)} (engines {quantity.length(disagreement)}, budget "
        f"{quantity.length(budget)})"
    )


def _smallest(ablation: Ablation) -> str:
    freedom = counted(ablation.degrees_of_freedom, "degree of freedom", "degrees of freedom")
    return (
        f"{freedom}; smallest model {counted(ablation.joint_coordinates, 'coordinate')}, "
        f"{counted(ablation.loop_conditions, 'condition')} of closed loops, "
        f"{counted(ablation.contact_spheres, 'contact pair')}"
    )


def _more(size: Size) -> str:
    """Report how much larger an engine's model is than the scene needs."""
    excess = [
        counted(count, noun)
        for count, noun in (
            (size.more_coordinates, "coordinate"),
            (size.more_constraints, "constraint"),
            (size.more_pairs, "contact pair"),
        )
        if count > 0
    ]
    return f"models {' and '.join(excess)} more than needed" if excess else "no more than needed"
