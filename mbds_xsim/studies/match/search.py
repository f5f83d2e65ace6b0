"""Matched settings: the cheapest of each engine that keep all of a scene's budgets, by search."""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import USUAL, Conduct, Crash, Task, run_tasks
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.measure.outcome import ReferenceOutcome
from mbds_xsim.measure.quick import Search
from mbds_xsim.measure.runner import machine
from mbds_xsim.measure.trial import Trial, failed_trial, joined, run_trial
from mbds_xsim.scene.sampling import Starts
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, fingerprint
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Choice, settings_for
from mbds_xsim.simulate.simulator import NATIVE, EngineMethod
from mbds_xsim.studies.match import SCHEMA, Found, Match
from mbds_xsim.studies.tradeoff import curves_of

_STARTS = Starts(2)
_SAMPLE = 3  # trajectories that run at other steps too
_DEAREST = 3.0
"""A method that costs so many times another one of its engine and has not passed is given up."""
_IN_USE = "in use"
_WORTH = 1.1
"""What differs from a plain search over steps must be cheaper by this factor."""
_NEAR = 1.1
"""Where nothing passes, the cheapest is taken that is at most so many times as far off as the best.
"""
_FAR = 2.0
"""So many times a budget is no matter of a little shorter steps."""
_CHUNKS = 6
_GRACE = 60.0
_PATIENCE = 8.0


@dataclass
class _Candidate:
    """A curve on which the fewest steps are looked for."""

    curve: EngineMethod
    search: Search = field(default_factory=Search)
    trials: dict[int, Trial] = field(default_factory=dict)
    """On the trajectories of the search, by steps a frame."""
    proofs: dict[int, Trial] = field(default_factory=dict)
    """On those that were held out."""
    least: float = 0.0
    """Cost that is known otherwise; what was measured may only be more."""

    @property
    def cost(self) -> float:
        """Processor time per simulated second of what was found; infinite where nothing was."""
        count = self.search.found
        return math.inf if count is None else max(self.least, self.cost_at(count))

    @property
    def rank(self) -> float:
        """The cost by which it competes: no option is changed for what may be noise."""
        return self.cost * (_WORTH if self.curve.variation else 1.0)

    def cost_at(self, count: int) -> float:
        """Measured, or by the trial of the next number of steps."""
        known = {k: t.cpu_s for k, t in self.trials.items() if math.isfinite(t.cpu_s)}
        if not known:
            return 0.0
        nearest = min(known, key=lambda k: abs(math.log(k / count)))
        return known[nearest] * count / nearest


@dataclass
class _Field:
    """Trajectories to try settings on, and where."""

    scene: Scene
    batch: Batch
    reference: ReferenceOutcome
    limit: float
    conduct: Conduct

    def run(self, asked: Sequence[tuple[EngineMethod, int]]) -> list[Trial]:
        """Try settings on all trajectories, each in a process of its own."""
        rows = list(range(len(self.batch)))
        return self._run([(curve, count, rows, _SAMPLE) for curve, count in asked])

    def run_spread(self, curve: EngineMethod, count: int) -> Trial:
        """Try one setting, its trajectories spread over processes."""
        places = list(range(len(self.batch)))
        parts = [places[k::_CHUNKS] for k in range(min(_CHUNKS, len(places)))]
        asked = [(curve, count, part, _SAMPLE if not k else 0) for k, part in enumerate(parts)]
        return joined(self._run(asked))

    def _run(self, asked: Sequence[tuple[EngineMethod, int, list[int], int]]) -> list[Trial]:
        def finished(place: int, _: Any) -> None:
            self.conduct.meter.advance(asked[place][0].name)

        tasks = [self._task(*what) for what in asked]
        answers = run_tasks(tasks, workers=self.conduct.workers, finished=finished)
        return [failed_trial(a) if isinstance(a, Crash) else a for a in answers]

    def _task(self, curve: EngineMethod, count: int, rows: list[int], sample: int) -> Task:
        settings: Settings = curve.settings(self.scene, count)
        reference = self.reference[rows]
        arguments = (self.scene, self.batch[rows], curve.engine, settings, reference, sample)
        return Task(run_trial, arguments, _GRACE + _PATIENCE * self.limit * len(rows))


def match(
    scene: Scene,
    *,
    choice: Choice,
    starts: Starts = _STARTS,
    held_out: int = 20,
    limit: float = 30.0,
    options: bool = False,
    conduct: Conduct = USUAL,
    command: str = "",
) -> Match:
    """Search the cheapest settings of each engine that keep all budgets, and verify them.

    For each method the fewest steps a frame are found by bisection, judged as `validate` judges,
    consistency included, and by the limits of contact. The settings in use compete. The cheapest
    is verified on trajectories of another seed; where it fails there it gets the next shorter
    step, and another method its turn when that one is cheaper by now.

    Args:
        scene: What to simulate.
        choice: Which engines.
        starts: To search with.
        held_out: Starts of each interval to verify with, by the next seed.
        limit: Longest rollout of a trajectory [s].
        options: Whether the options that adapters declare worth trying are varied too.
        conduct: How.
        command: For the record.

    Raises:
        InputError: Something that was given cannot be used.
    """
    curves, left_out = _curves(scene, choice, options=options)
    field_of = partial(_field, scene, limit=limit, conduct=conduct)
    ground, seed = field_of(starts), starts.seed
    used = _used(ground, {curve.engine for curve in curves})
    candidates = _searched(ground, curves, used)
    proof = field_of(dataclasses.replace(starts, trajectories=held_out, seed=seed + 1))
    engines = dict.fromkeys(curve.engine for curve in curves)
    return Match(
        schema=SCHEMA,
        scene=scene.name,
        command=command,
        seed=seed,
        held_out_seed=seed + 1,
        trajectories=starts.trajectories,
        held_out=held_out,
        machine=machine(),
        engines=tuple(_settle(ground, proof, candidates, used, name) for name in engines),
        left_out=left_out,
        fingerprint=fingerprint(scene),
    )


def _field(scene: Scene, starts: Starts, *, limit: float, conduct: Conduct) -> _Field:
    """Draw starts, and solve what they are held against."""
    batch = starts.draw(scene)
    return _Field(scene, batch, run_references(scene, batch, conduct), limit, conduct)


def _curves(
    scene: Scene, choice: Choice, *, options: bool
) -> tuple[list[EngineMethod], dict[str, str]]:
    """List the engines' own methods, with other options if asked for, and what is left out."""
    curves, left_out = curves_of(scene, choice.engines)
    left_out |= choice.faulty
    curves = [c for c in curves if c.variation != NATIVE and (options or not c.variation)]
    curves = [c for c in curves if registry.load_adapter(c.engine).methods[c.method].own]
    if not curves:
        msg = f"no engine can do {scene.name}: {next(iter(left_out.values()), 'none is installed')}"
        raise InputError(msg)
    return curves, left_out


def _used(ground: _Field, engines: set[str]) -> dict[str, tuple[Settings, Trial]]:
    """Try the settings in use until now."""
    scene, found = ground.scene, {}
    asked = []
    for name in sorted(engines):
        settings = settings_for(scene, registry.load_adapter(name), "matched")
        count = settings.substeps(scene.clock.frame)
        curve = EngineMethod(name, settings.method, given=settings.options, counts=(count,))
        asked.append((curve, count))
        found[name] = settings
    trials = ground.run(asked)
    pairs = zip(asked, trials, strict=True)
    return {curve.engine: (found[curve.engine], trial) for (curve, _), trial in pairs}


def _in_use(scene: Scene, engine: str, settings: Settings, trial: Trial) -> _Candidate:
    """Let the settings in use compete, so that what is found is never dearer than they are."""
    count = settings.substeps(scene.clock.frame)
    curve = EngineMethod(
        engine, settings.method, variation=_IN_USE, given=settings.options, counts=(count,)
    )
    own = registry.load_adapter(engine).methods[settings.method].own
    search = Search(counts=(count,))
    search.tell(count, trial.passed and own)
    return _Candidate(curve, search, {count: trial} if own else {})


def _rate_alike(candidates: Sequence[_Candidate]) -> None:
    """Let no clock say that the settings in use are cheaper than fewer steps of the same."""

    def settings(candidate: _Candidate) -> tuple[str, str, dict[str, Any]]:
        curve = candidate.curve
        return curve.engine, curve.method, dict(curve.given or {})

    for used in (c for c in candidates if c.curve.variation == _IN_USE):
        (count,) = used.search.counts
        for other in candidates:
            fewer = other is not used and (other.search.found or math.inf) <= count
            if fewer and settings(other) == settings(used):
                used.least = other.cost_at(count)


def _searched(
    ground: _Field, curves: Sequence[EngineMethod], used: Mapping[str, tuple[Settings, Trial]]
) -> list[_Candidate]:
    """Search on all curves; the settings in use compete."""
    candidates = [_Candidate(curve) for curve in curves]
    candidates += [_in_use(ground.scene, name, *tried) for name, tried in used.items()]
    _search(ground, candidates)
    _rate_alike(candidates)
    return candidates


def _search(ground: _Field, candidates: list[_Candidate]) -> None:
    """Advance all searches together, a trial each at a time."""
    while True:
        for candidate in candidates:
            if _hopeless(ground, candidate, candidates):
                candidate.search.closed = True
        asked = [(c, count) for c in candidates if (count := c.search.next) is not None]
        if not asked:
            return
        ground.conduct.meter.forecast(_left(ground, asked))
        trials = ground.run([(candidate.curve, count) for candidate, count in asked])
        for (candidate, count), trial in zip(asked, trials, strict=True):
            candidate.trials[count] = trial
            candidate.search.tell(count, trial.passed)


def _hopeless(ground: _Field, candidate: _Candidate, candidates: list[_Candidate]) -> bool:
    """Whether the next trial would take too long, or another method has won already."""
    count = candidate.search.next
    if count is None or candidate.search.passed is not None or not candidate.trials:
        return False
    cost = candidate.cost_at(count)
    rivals = [c.cost for c in candidates if c.curve.engine == candidate.curve.engine]
    return cost * ground.scene.clock.duration > ground.limit or cost > _DEAREST * min(rivals)


def _left(ground: _Field, asked: list[tuple[_Candidate, int]]) -> float:
    """Work of some rounds more [s of one worker]."""
    simulated = len(ground.batch) * ground.scene.clock.duration
    return 3.0 * sum(2.0 + 2.0 * simulated * c.cost_at(count) for c, count in asked)


def _settle(
    ground: _Field,
    proof: _Field,
    every: list[_Candidate],
    tried: Mapping[str, tuple[Settings, Trial]],
    engine: str,
) -> Found:
    """Verify the cheapest; after a failure the next shorter step, or a method cheaper by now."""
    candidates, used = [c for c in every if c.curve.engine == engine], tried[engine]
    queue = [(c.rank, place) for place, c in enumerate(candidates) if c.cost < math.inf]
    heapq.heapify(queue)
    while queue:
        _, place = heapq.heappop(queue)
        candidate = candidates[place]
        count = candidate.search.found
        assert count is not None
        trial = proof.run_spread(candidate.curve, count)
        candidate.proofs[count] = trial
        if trial.passed:
            if count not in candidate.trials:  # told apart from the settings until now
                (candidate.trials[count],) = ground.run([(candidate.curve, count)])
            return _found(proof, candidate, count, trial, candidates, used)
        candidate.search.refuse(count)
        if _stuck(candidate):
            continue
        if candidate.cost * proof.scene.clock.duration <= proof.limit:
            heapq.heappush(queue, (candidate.rank, place))
    return _best_effort(proof, candidates, used)


def _stuck(candidate: _Candidate) -> bool:
    """Whether the last proof was far off, and no nearer than one with half as many steps.

    Between neighbouring steps it may be: errors of long steps follow no order.
    """
    *before, (count, last) = ((n, trial.excess) for n, trial in candidate.proofs.items())
    coarse = [excess for n, excess in before if 2 * n <= count]
    return _FAR < last < math.inf and any(last > excess / _NEAR for excess in coarse)


def _best_effort(
    proof: _Field, candidates: list[_Candidate], used: tuple[Settings, Trial]
) -> Found:
    """Give the setting that came nearest to the budgets, with its figures on what was held out.

    It breaks as few checks as any and is near on those. What came as far as the held-out
    trajectories, having passed the others, is judged by them; else by the others.
    """
    proved = [(t, k, n) for k, c in enumerate(candidates) for n, t in c.proofs.items()]
    every = [(t, k, n) for k, c in enumerate(candidates) for n, t in c.trials.items()]
    fewest = min(trial.broken for trial, *_ in proved or every)
    tried = [what for what in proved or every if what[0].broken == fewest]
    most = _NEAR * min(trial.excess for trial, *_ in tried)
    near = [what for what in tried if what[0].excess <= most]
    _, place, count = min(near, key=lambda what: what[0].cpu_s)
    candidate = candidates[place]
    trial = candidate.proofs.get(count) or proof.run_spread(candidate.curve, count)
    if trial.passed:  # not on the starts of the search
        trial = dataclasses.replace(trial, reasons=candidate.trials[count].reasons)
    return _found(proof, candidate, count, trial, candidates, used)


def _found(
    proof: _Field,
    candidate: _Candidate,
    count: int,
    trial: Trial,
    candidates: list[_Candidate],
    used: tuple[Settings, Trial],
) -> Found:
    curve, (settings, until_now) = candidate.curve, used
    here = candidate.trials.get(count)
    return Found(
        engine=curve.engine,
        version=registry.load_adapter(curve.engine).version(),
        method=curve.method,
        steps_per_frame=count,
        step_s=proof.scene.clock.frame / count,
        options=dict(curve.given or {}),
        meets_budget=trial.passed,
        reasons=trial.reasons,
        held_out=len(proof.batch),
        wall_per_simulated_s=trial.wall_s,
        cpu_per_simulated_s=trial.cpu_s,
        **trial.figures,
        used_method=settings.method,
        used_steps_per_frame=settings.substeps(proof.scene.clock.frame),
        cost_ratio=here.cpu_s / until_now.cpu_s if until_now.passed and here else None,
        trials=sum(len(c.trials) + len(c.proofs) for c in candidates),
    )
