"""Search for matched settings: the cheapest of each engine that keep all budgets of a scene."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
from mbds_xsim.studies.match import SCHEMA, Match, MatchedSettings
from mbds_xsim.studies.tradeoff import curves_of

_STARTS = Starts(2)
_SAMPLE = 3  # trajectories that also run at other steps
_DEAREST = 3.0
"""A method that has not passed is given up at so many times the cost of its engine's cheapest."""
_IN_USE = "in use"
_WORTH = 1.1
"""Factor by which changed options and settings in use must be cheaper than plain methods."""
_NEAR = 1.1
"""If nothing passes, the cheapest setting within this factor of the smallest excess is taken."""
_FAR = 2.0
"""Excess over a budget that slightly shorter steps cannot remove."""
_CHUNKS = 6
_GRACE = 60.0
_PATIENCE = 8.0


@dataclass(eq=False)
class _Candidate:
    """A curve that is searched for the fewest steps that pass."""

    curve: EngineMethod
    search: Search = field(default_factory=Search)
    trials: dict[int, Trial] = field(default_factory=dict)
    """Trials on the trajectories of the search, keyed by steps per frame."""
    proofs: dict[int, Trial] = field(default_factory=dict)
    """Trials on the held-out trajectories, keyed by steps per frame."""
    least: float = 0.0
    """Lower bound of the cost, known from another candidate."""

    @property
    def cost(self) -> float:
        """Processor time per simulated second at the steps found; infinite if none were found."""
        count = self.search.smallest
        return math.inf if count is None else max(self.least, self.cost_at(count))

    @property
    def rank(self) -> float:
        """Cost for the ranking, raised for changed options and the settings in use."""
        return self.cost * (_WORTH if self.curve.variation else 1.0)

    def cost_at(self, count: int) -> float:
        """Return the cost at a number of steps, scaled from the nearest trial; 0 if unknown."""
        known = {k: t.cpu_s for k, t in self.trials.items() if math.isfinite(t.cpu_s)}
        if not known:
            return 0.0
        nearest = min(known, key=lambda k: abs(math.log(k / count)))
        return known[nearest] * count / nearest


@dataclass
class _Field:
    """Trajectories on which settings are tried, with their reference."""

    scene: Scene
    batch: Batch
    reference: ReferenceOutcome
    limit: float
    conduct: Conduct

    def run(self, pairs: Sequence[tuple[EngineMethod, int]]) -> list[Trial]:
        """Try settings on all trajectories, each setting in its own process."""
        rows = list(range(len(self.batch)))
        return self._run([(curve, count, rows, _SAMPLE) for curve, count in pairs])

    def run_spread(self, curve: EngineMethod, count: int) -> Trial:
        """Try one setting, with its trajectories spread over processes."""
        places = list(range(len(self.batch)))
        parts = [places[k::_CHUNKS] for k in range(min(_CHUNKS, len(places)))]
        jobs = [(curve, count, part, _SAMPLE if not k else 0) for k, part in enumerate(parts)]
        return joined(self._run(jobs))

    def _run(self, jobs: Sequence[tuple[EngineMethod, int, list[int], int]]) -> list[Trial]:
        tasks = []
        for curve, count, rows, sample in jobs:
            how = (curve.engine, curve.settings(self.scene, count))
            arguments = (self.scene, self.batch[rows], *how, self.reference[rows], sample)
            tasks.append(Task(run_trial, arguments, _GRACE + _PATIENCE * self.limit * len(rows)))
        answers = run_tasks(
            tasks,
            workers=self.conduct.workers,
            finished=lambda place, _: self.conduct.meter.advance(jobs[place][0].name),
        )
        return [failed_trial(a) if isinstance(a, Crash) else a for a in answers]


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
    """Search for the cheapest settings of each engine that keep all budgets, and verify them.

    For each method, bisection finds the fewest steps per frame that pass the checks of `validate`,
    including consistency, and the limits of contact. The settings in use compete. The cheapest
    candidate is verified on trajectories of another seed. If it fails there, it gets the next
    shorter step; if another method is then cheaper, that one is verified first.

    Args:
        scene: Scene to simulate.
        choice: Engines to search.
        starts: Starts of the search.
        held_out: Number of starts per interval for the verification, drawn with the next seed.
        limit: Longest rollout of a trajectory [s].
        options: Whether the options that adapters declare worth trying are varied too.
        conduct: How the work is carried out.
        command: Command to record in the result.

    Raises:
        InputError: An argument cannot be used.
    """
    curves, left_out = searched_curves(scene, choice, options=options)

    def field_of(starts: Starts) -> _Field:
        batch = starts.draw(scene)
        return _Field(scene, batch, run_references(scene, batch, conduct), limit, conduct)

    ground, seed = field_of(starts), starts.seed
    used = _try_settings_in_use(ground, {curve.engine for curve in curves})
    candidates = _search_all(ground, curves, used)
    proof = field_of(dataclasses.replace(starts, trajectories=held_out, seed=seed + 1))

    def settled(engine: str) -> MatchedSettings:
        own = [candidate for candidate in candidates if candidate.curve.engine == engine]
        return _Contest(ground, proof, own, *used[engine]).settle()

    return Match(
        schema=SCHEMA,
        scene=scene.name,
        command=command,
        seed=seed,
        held_out_seed=seed + 1,
        trajectories=starts.trajectories,
        held_out=held_out if len(proof.batch) > 1 else 0,
        machine=machine(),
        engines=tuple(map(settled, dict.fromkeys(curve.engine for curve in curves))),
        left_out=left_out,
        fingerprint=fingerprint(scene),
    )


def searched_curves(
    scene: Scene, choice: Choice, *, options: bool
) -> tuple[list[EngineMethod], dict[str, str]]:
    """List the engines' own methods, with changed options if asked for, and those left out.

    Raises:
        InputError: No engine has a method of its own for the scene.
    """
    able, left_out = curves_of(scene, choice.engines)
    left_out |= choice.faulty
    own = [c for c in able if registry.load_adapter(c.engine).methods[c.method].own]
    for engine in dict.fromkeys(c.engine for c in able):
        if not any(method.own for method in registry.load_adapter(engine).methods.values()):
            left_out[engine] = (
                f"{engine} does not step itself: this toolkit steps it, so there are no settings "
                "of the engine's own to match"
            )
    for curve in own:
        if curve.digits and not curve.variation:
            left_out[f"{curve.engine} {curve.method}"] = (
                f"{curve.engine}'s {curve.method} is adaptive: its tolerance decides the accuracy, "
                "and only steps per frame are searched; see tradeoff"
            )
    curves = [c for c in own if not c.digits and c.variation != NATIVE]
    curves = [c for c in curves if options or not c.variation]
    if not curves:
        why = next(iter(left_out.values()), "none is installed")
        raise InputError(f"no engine can be matched on {scene.name}: {why}")
    return curves, left_out


def _try_settings_in_use(ground: _Field, engines: set[str]) -> dict[str, tuple[Settings, Trial]]:
    """Try each engine's settings in use."""
    adapters = {name: registry.load_adapter(name) for name in sorted(engines)}
    used = {name: settings_for(ground.scene, each, "matched") for name, each in adapters.items()}
    curves = [_curve_in_use(ground.scene, *item) for item in used.items()]
    trials = ground.run([(curve, curve.counts[0]) for curve in curves])
    return {name: (used[name], trial) for name, trial in zip(used, trials, strict=True)}


def _curve_in_use(
    scene: Scene, engine: str, settings: Settings, variation: str = ""
) -> EngineMethod:
    counts, options = (settings.substeps(scene.clock.frame),), settings.options
    return EngineMethod(
        engine, settings.method, variation=variation, own_options=options, counts=counts
    )


def _in_use(scene: Scene, engine: str, settings: Settings, trial: Trial) -> _Candidate:
    """Make a candidate of the settings in use, so that the result never costs more than they do."""
    curve = _curve_in_use(scene, engine, settings, _IN_USE)
    (count,) = curve.counts
    own = registry.load_adapter(engine).methods[settings.method].own
    search = Search(counts=curve.counts)
    search.tell(count, trial.passed and own)
    return _Candidate(curve, search, {count: trial} if own else {})


def _rate_alike(candidates: Sequence[_Candidate]) -> None:
    """Keep timing noise from ranking the settings in use below the same with fewer steps."""

    def settings(candidate: _Candidate) -> tuple[str, str, dict[str, Any]]:
        curve = candidate.curve
        return curve.engine, curve.method, dict(curve.own_options or {})

    for used in (c for c in candidates if c.curve.variation == _IN_USE):
        (count,) = used.search.counts
        for other in candidates:
            fewer = other is not used and (other.search.smallest or math.inf) <= count
            if fewer and settings(other) == settings(used):
                used.least = other.cost_at(count)


def _search_all(
    ground: _Field, curves: Sequence[EngineMethod], used: Mapping[str, tuple[Settings, Trial]]
) -> list[_Candidate]:
    """Search all curves together, one trial of each at a time; the settings in use compete."""
    candidates = [_Candidate(curve) for curve in curves]
    candidates += [_in_use(ground.scene, name, *pair) for name, pair in used.items()]
    while True:
        for candidate in candidates:
            if _hopeless(ground, candidate, candidates):
                candidate.search.closed = True
        pending = [(c, count) for c in candidates if (count := c.search.next) is not None]
        if not pending:
            break
        ground.conduct.meter.forecast(_remaining_work(ground, pending))
        trials = ground.run([(candidate.curve, count) for candidate, count in pending])
        for (candidate, count), trial in zip(pending, trials, strict=True):
            candidate.trials[count] = trial
            candidate.search.tell(count, trial.passed)
    _rate_alike(candidates)
    return candidates


def _hopeless(ground: _Field, candidate: _Candidate, candidates: list[_Candidate]) -> bool:
    """Return whether the next trial would take too long, or another method has already won."""
    count = candidate.search.next
    if count is None or candidate.search.passed is not None or not candidate.trials:
        return False
    cost = candidate.cost_at(count)
    rivals = [c.cost for c in candidates if c.curve.engine == candidate.curve.engine]
    return cost * ground.scene.clock.duration > ground.limit or cost > _DEAREST * min(rivals)


def _remaining_work(ground: _Field, pending: list[tuple[_Candidate, int]]) -> float:
    """Predict the work of a few more rounds [s of one worker]."""
    simulated = len(ground.batch) * ground.scene.clock.duration
    return 3.0 * sum(2.0 + 2.0 * simulated * c.cost_at(count) for c, count in pending)


@dataclass
class _Contest:
    """Candidates of one engine, tried on some trajectories and verified on others."""

    ground: _Field
    proof: _Field
    candidates: list[_Candidate]
    used: Settings
    """Settings in use."""
    until_now: Trial
    """Trial of the settings in use."""

    def settle(self) -> MatchedSettings:
        """Verify the cheapest; if it fails, its next shorter step, or what is now cheaper."""
        pending = [c for c in self.candidates if c.cost < math.inf]
        while pending:
            candidate = min(pending, key=lambda c: c.rank)
            count = candidate.search.smallest
            assert count is not None
            trial = self.proof.run_spread(candidate.curve, count)
            candidate.proofs[count] = trial
            if trial.passed:
                if count not in candidate.trials:  # for its cost ratio to the settings in use
                    (candidate.trials[count],) = self.ground.run([(candidate.curve, count)])
                return self._settings(candidate, count, trial)
            candidate.search.refuse(count)
            too_slow = candidate.cost * self.proof.scene.clock.duration > self.proof.limit
            if too_slow or _stuck(candidate):
                pending.remove(candidate)
        return self.best_effort()

    def best_effort(self) -> MatchedSettings:
        """Return the setting nearest to the budgets, with its figures on held-out trajectories.

        Of the settings that lose nothing, if there are any, and of those the ones that break the
        fewest checks, it is the cheapest of the nearest. If any setting passed the search and was
        verified, only verified ones count; else the search's trials do.
        """

        def faults(trial: Trial) -> tuple[bool, int]:
            return not math.isfinite(trial.excess), trial.broken  # what was lost was not judged

        proofs = [(t, c, n) for c in self.candidates for n, t in c.proofs.items()]
        trials = [(t, c, n) for c in self.candidates for n, t in c.trials.items()]
        fewest = min(faults(trial) for trial, *_ in proofs or trials)
        best = [entry for entry in proofs or trials if faults(entry[0]) == fewest]
        largest = _NEAR * min(trial.excess for trial, *_ in best)
        near = [entry for entry in best if entry[0].excess <= largest]
        _, candidate, count = min(near, key=lambda entry: entry[0].cpu_s)
        trial = candidate.proofs.get(count) or self.proof.run_spread(candidate.curve, count)
        if trial.passed:  # it failed only on the starts of the search
            trial = dataclasses.replace(trial, reasons=candidate.trials[count].reasons)
        return self._settings(candidate, count, trial)

    def _settings(self, candidate: _Candidate, count: int, trial: Trial) -> MatchedSettings:
        curve, frame = candidate.curve, self.proof.scene.clock.frame
        here, until_now = candidate.trials.get(count), self.until_now
        return MatchedSettings(
            engine=curve.engine,
            version=registry.load_adapter(curve.engine).version(),
            method=curve.method,
            steps_per_frame=count,
            step_s=frame / count,
            options=dict(curve.own_options or {}),
            meets_budget=trial.passed,
            reasons=trial.reasons,
            held_out=len(self.proof.batch),
            wall_per_simulated_s=trial.wall_s,
            cpu_per_simulated_s=trial.cpu_s,
            **trial.figures,
            used_method=self.used.method,
            used_steps_per_frame=self.used.substeps(frame),
            cost_ratio=here.cpu_s / until_now.cpu_s if until_now.passed and here else None,
            trials=sum(len(c.trials) + len(c.proofs) for c in self.candidates),
        )


def _stuck(candidate: _Candidate) -> bool:
    """Return whether the last proof was far off, and no nearer than one with half as many steps.

    Neighbouring steps are not compared: errors of long steps follow no order.
    """
    *before, (count, last) = ((n, trial.excess) for n, trial in candidate.proofs.items())
    coarse = [excess for n, excess in before if 2 * n <= count]
    return _FAR < last < math.inf and any(last > excess / _NEAR for excess in coarse)
