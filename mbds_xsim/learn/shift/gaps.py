"""Cost of a change of engine: models on a domain compared with models that were trained there.

Intervals are from a paired bootstrap. In addition to the gaps, agreements show whether engines, and
the paper, rank the models alike.
"""

from __future__ import annotations

import csv
import functools
import itertools
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from scipy.stats import kendalltau

from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.shift.evaluation import Evaluation, known_mean
from mbds_xsim.learn.shift.result import INTERVALS, Agreement, Gap, Values, values
from mbds_xsim.learn.trained import TrainedModel

Errors = dict[tuple[str, int], float]
"""Mean errors by model and frame."""
Look = Callable[[TrainedModel, str], Array]
"""Function for errors of a training on a domain: means (frame,) or resampled ones (draw, frame)."""

SINGLE, LEAVE_ONE_OUT, ALL = "single", "leave-one-out", "all"

WEAK = "own error exceeds the engine floor"
UNSURE = "interval contains 0"
LONELY = "one trajectory gives no interval"
UNKNOWN = "own domain is not tested, so neither own error nor engine floor is known"
"""Reasons why a gap says nothing about a shift."""

PAPER = "the paper"
DRAWS = 1000
"""Number of bootstrap draws."""
_LEVEL = 0.95
_SEED = 20240607
_SEVERAL = 2  # trajectories: one alone does not show how others would vary
_LEAST = 3  # models: two can only agree or disagree


@dataclass(frozen=True)
class Bounded:
    """Figure at the frames with its 95 % interval, each of shape (frame,)."""

    value: Array
    low: Array
    high: Array

    @staticmethod
    def of(figure: Callable[[Any], Array], mean: Any, drawn: Any) -> Bounded:
        """Compute a figure from the mean errors, and its bounds from the resampled ones."""
        with np.errstate(divide="ignore", invalid="ignore"):  # NaN where both are 0
            return Bounded(figure(mean), *bounds_of(figure(drawn)))

    def text(self, place: int) -> str:
        """Format value and interval at a frame."""
        if np.isnan(self.low[place]):
            return f"{self.value[place]:.3g} [no interval]"
        return f"{self.value[place]:.3g} [{self.low[place]:.3g}, {self.high[place]:.3g}]"

    def verdict(self, place: int) -> str:
        """Say of what leads to a ratio of errors whether that is below 1, above 1, or neither."""
        if self.high[place] < 1.0:
            return "helps"
        return "harms" if self.low[place] > 1.0 else "makes no difference that can be told"

    def rounded(self, name: str = "") -> dict[str, Values]:
        """Return the figures to store, as `value`, `low` and `high` or as `name`, `name_low`, …."""
        keys = (name, f"{name}_low", f"{name}_high") if name else ("value", "low", "high")
        return dict(zip(keys, map(values, (self.value, self.low, self.high)), strict=True))


class Draws:
    """Mean errors of trainings on domains, and resampled ones, all drawn together.

    A training stands for all its seeds.
    """

    def __init__(self, evaluation: Evaluation, interval: str = INTERVALS[0]) -> None:
        self.evaluation, self._rows = evaluation, evaluation.rows(interval)
        self._resampler = Resampler(int(self._rows.sum()))
        self.mean = functools.cache(self._mean)
        self.drawn, self.reseeded = map(functools.cache, (self._drawn, self._reseeded))

    def bounded(self, figure: Callable[[Look], Array]) -> Bounded:
        """Compute a figure from errors of trainings on domains, and its interval."""
        return Bounded.of(figure, self.mean, self.drawn)

    def _mean(self, training: TrainedModel, test: str) -> Array:
        return np.asarray(self._errors(training, test).mean(axis=(0, 1)))

    def _drawn(self, training: TrainedModel, test: str) -> Array:
        return self._resampler.means(self._errors(training, test), self._runs(training))

    def _reseeded(self, training: TrainedModel, test: str) -> Array:
        """Return the means of as many draws of the seeds alone."""
        means = self._errors(training, test).mean(axis=1)
        return self._resampler.seeds(self._runs(training), len(means)) @ means

    def _runs(self, training: TrainedModel) -> str:
        return f"{training.model} {[run.seed for run in self.evaluation.runs(training)]}"

    def _errors(self, training: TrainedModel, test: str) -> Array:
        return self.evaluation.errors(training, test)[:, self._rows]


def trainings_of(evaluation: Evaluation, model: str) -> list[TrainedModel]:
    """Return one run of each training of a model on all starts, in order.

    With two engines, a training that leaves one out is the training on the other.
    """
    by_domains: dict[tuple[str, ...], TrainedModel] = {}
    for run in evaluation.entries:
        if run.model == model and not run.interval:
            current = by_domains.setdefault(run.domains, run)
            if current.training not in run.domains and run.training in run.domains:
                by_domains[run.domains] = run
    return list(by_domains.values())


def singles_of(evaluation: Evaluation, model: str) -> list[TrainedModel]:
    """Return the trainings on one domain that is tested, too."""
    tested = {domain.name for domain in evaluation.test.domains}
    return [t for t in trainings_of(evaluation, model) if t.single and t.domains[0] in tested]


def kind_of(training: TrainedModel, test: str, every: Sequence[str]) -> str:
    """Return the kind of a training for a test domain; "" if there is no shift between them.

    Trainings on several engines count on engines that they left out, in any variant: single ones
    show the effect of other settings of a known engine. `every` names all engine domains.
    """
    if training.single:
        return "" if test in training.domains else SINGLE
    own = {domain for domain in every if domain.endswith(f"-{training.variant}")}
    if own <= set(training.domains):
        return ALL
    return "" if test.rpartition("-")[0] in training.engines else LEAVE_ONE_OUT


def gaps_of(draws: Draws) -> Iterator[Gap]:
    """Yield all gaps to models that were trained on the target."""
    evaluation = draws.evaluation
    every = [domain.name for domain in evaluation.test.domains]
    for model in evaluation.models:
        trainings = trainings_of(evaluation, model)
        targets = {training.domains[0]: training for training in trainings if training.single}
        for training, test in itertools.product(trainings, every):
            kind = kind_of(training, test, every)
            if kind and test in targets:
                yield _gap(draws, kind, training, targets[test])


def why_unresolved(own: float, floor: float, low: float, high: float) -> str:
    """Return why a gap says nothing about a shift; "" if it does.

    `own` is the training's error on its own domain and `floor` its engine's squared distance
    from the target, both NaN if that domain is not tested; `low` and `high` bound the difference of
    errors; all in m².
    """
    if np.isnan(own) or np.isnan(floor):
        return UNKNOWN
    if own > floor:
        return WEAK
    if np.isnan(low):
        return LONELY
    return "" if low > 0.0 or high < 0.0 else UNSURE


def _gap(draws: Draws, kind: str, training: TrainedModel, target: TrainedModel) -> Gap:
    test, evaluation = target.domains[0], draws.evaluation
    unknown = np.full((1, max(evaluation.frames)), np.nan)
    own, floor = own_and_floor(draws, training, test)
    ratio = draws.bounded(lambda look: look(training, test) / look(target, test))
    difference = draws.bounded(lambda look: look(training, test) - look(target, test))
    bounds = zip(own, floor, difference.low, difference.high, strict=True)
    why = tuple(why_unresolved(*each) for each in bounds)
    noise, chaos = (
        known_mean(evaluation.counted(evaluation.floors.get(name, unknown)))
        for name in ("noise", "chaos")
    )
    return Gap(
        model=training.model,
        kind=kind,
        training=training.training,
        test=test,
        seeds=(len(evaluation.runs(training)), len(evaluation.runs(target))),
        own=values(own),
        transferred=values(draws.mean(training, test)),
        target=values(draws.mean(target, test)),
        **ratio.rounded("ratio"),
        **difference.rounded("difference"),
        engine_floor=values(floor),
        noise_floor=values(noise),
        chaos_floor=values(chaos),
        resolved=tuple(not reason for reason in why),
        why=why,
    )


def own_and_floor(draws: Draws, training: TrainedModel, test: str) -> tuple[Array, Array]:
    """Return R_ii and D_ij of the training's engine i with the least bound √R_ii + √D_ij on √R_ij.

    Both are NaN if no other domain of the training is tested.
    """
    evaluation = draws.evaluation
    tested = {domain.name for domain in evaluation.test.domains}
    others = [n for n in training.domains if n in tested and (n, test) in evaluation.oracles]
    if not others:
        return (np.full(len(evaluation.frames), np.nan),) * 2
    own = np.stack([draws.mean(training, name) for name in others])
    floor = np.stack([evaluation.floor(name, test).mean(axis=0) for name in others])
    bound = np.sqrt(own) + np.sqrt(floor)
    index = np.where(np.isnan(bound), np.inf, bound).argmin(axis=0)[None]
    return np.take_along_axis(own, index, 0)[0], np.take_along_axis(floor, index, 0)[0]


class Resampler:
    """Bootstrap with the same trajectories for every model and domain, so shared errors cancel.

    Runs of a seed share first weights and the order of windows, whatever they are trained on, so
    seeds are drawn together, too.
    """

    def __init__(self, trajectories: int, *, draws: int = DRAWS) -> None:
        self._draws = draws
        self._weights = _weights(np.random.default_rng([_SEED]), draws, trajectories)

    def means(self, errors: Array, runs: str) -> Array:
        """Return resampled means (draw, frame) of finite errors (seed, trajectory, frame).

        The same seeds are drawn for the same name of runs. The means of a single trajectory are
        NaN, because it does not show how much others would differ.
        """
        if errors.shape[1] < _SEVERAL:
            return np.full((self._draws, errors.shape[2]), np.nan)
        each = np.einsum("dt,stf->dsf", self._weights, errors, optimize=True)
        return np.einsum("ds,dsf->df", self.seeds(runs, len(errors)), each)

    def seeds(self, runs: str, count: int) -> Array:
        """Return the weights of so many seeds in each draw, (draw, seed)."""
        rng = np.random.default_rng([_SEED, zlib.crc32(runs.encode())])
        return _weights(rng, self._draws, count)


def bounds_of(draws: Array) -> tuple[Array, Array]:
    """Return the bounds of the central 95 % of draws, frame by frame; NaN if a draw is NaN."""
    tail = 0.5 * (1.0 - _LEVEL)
    low, high = np.quantile(draws, [tail, 1.0 - tail], axis=0)
    return low, high


def _weights(rng: np.random.Generator, draws: int, count: int) -> Array:
    """Draw `count` − 1 of `count` items as weights, so that means vary as those of new items would.

    With `count`, their variance would be too small by one part in `count` (Rao and Wu 1988, J. Am.
    Stat. Assoc. 83, 231): little for a hundred trajectories, but a third for three seeds.
    """
    trials = max(count - 1, 1)
    return np.asarray(rng.multinomial(trials, np.full(count, 1.0 / count), draws) / trials)


def agreements_of(draws: Draws) -> Iterator[Agreement]:
    """Compare rankings of models at home between domains, and with the paper's."""
    evaluation, orders = draws.evaluation, _orders(draws)
    paper = paper_errors(evaluation.test.scene.name, flagged=False)
    if orders and paper:
        orders[PAPER] = paper
    for (first, one), (second, two) in itertools.combinations(orders.items(), 2):
        for frame in evaluation.frames:
            both = [model for model, at in one if at == frame and (model, frame) in two]
            if both:
                here, there = ({m: order[m, frame] for m in both} for order in (one, two))
                yield Agreement(first, second, frame, tuple(both), ranks_alike(here, there))


def ranks_alike(first: Mapping[str, float], second: Mapping[str, float]) -> float | None:
    """Return Kendall's τ-b of the models that both have; None if fewer than three, or all tied."""
    both = [model for model in first if model in second]
    if len(both) < _LEAST:
        return None
    tau = float(kendalltau([first[m] for m in both], [second[m] for m in both]).statistic)
    return None if np.isnan(tau) else tau


def paper_errors(scene: str, *, flagged: bool = True) -> Errors:
    """Return the paper's printed errors of a scene over all speeds [m², if its unit is the metre].

    `flagged` includes those that a note says cannot be right as printed.
    """
    return {
        (row["model"].lower(), int(row["t"])): float(row["mean_si"])
        for row in paper_rows()
        if row["scenario"].replace("-", "").lower() == scene
        if not row["speed"] and (flagged or not row["note"])
    }


def paper_rows() -> list[dict[str, str]]:
    """Return the figures that the paper's tables print, one per row."""
    text = resources.files("mbds_xsim.learn.shift").joinpath("paper.csv").read_text("utf-8")
    return list(csv.DictReader(text.splitlines()))


def _orders(draws: Draws) -> dict[str, Errors]:
    """Return the mean errors of models at home, by domain."""
    evaluation, orders = draws.evaluation, dict[str, Errors]()
    for training in (t for model in evaluation.models for t in singles_of(evaluation, model)):
        home = training.domains[0]
        means = zip(evaluation.frames, draws.mean(training, home).tolist(), strict=True)
        orders.setdefault(home, {}).update({(training.model, f): x for f, x in means})
    return orders
