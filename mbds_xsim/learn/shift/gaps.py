"""What a change of engine costs: models on a domain against those that were trained there.

Intervals are by paired bootstrap. Beside the gaps stands whether engines, and the paper, put the
models in one order.
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
from mbds_xsim.learn.shift.result import INTERVALS, Agreement, Gap, values
from mbds_xsim.learn.trained import TrainedModel

Errors = dict[tuple[str, int], float]
"""Mean errors by model and frame."""
Look = Callable[[TrainedModel, str], Array]
"""Gives errors of a training on a domain: means (frame,), or resampled ones (draw, frame)."""

SINGLE, LEAVE_ONE_OUT, ALL = "single", "leave-one-out", "all"

WEAK = "own error exceeds the engine floor"
UNSURE = "interval contains 0"
LONELY = "one trajectory gives no interval"
UNKNOWN = "own domain is not tested, so neither own error nor engine floor is known"
"""Why gaps tell nothing of a shift."""

PAPER = "the paper"
DRAWS = 1000
"""Of the bootstrap."""
_LEVEL = 0.95
_SEED = 20240607
_SEVERAL = 2  # trajectories: of one alone nothing tells what another would give
_LEAST = 3  # models: two can only be in order or out of it


@dataclass(frozen=True)
class Bounded:
    """A figure at the frames with its 95 % interval, each of shape (frame,)."""

    value: Array
    low: Array
    high: Array

    @staticmethod
    def of(figure: Callable[[Any], Array], mean: Any, drawn: Any) -> Bounded:
        """Compute a figure from the mean errors, and its bounds from the resampled ones."""
        with np.errstate(divide="ignore", invalid="ignore"):  # not a number where both are 0
            return Bounded(figure(mean), *bounds_of(figure(drawn)))

    def text(self, place: int) -> str:
        """Write value and interval at a frame."""
        if np.isnan(self.low[place]):
            return f"{self.value[place]:.3g} [no interval]"
        return f"{self.value[place]:.3g} [{self.low[place]:.3g}, {self.high[place]:.3g}]"

    def verdict(self, place: int, less: str, more: str, same: str) -> str:
        """Choose the words for a ratio that is below 1, above 1, or neither for certain."""
        if self.high[place] < 1.0:
            return less
        return more if self.low[place] > 1.0 else same


class Draws:
    """Mean errors of trainings on domains, and resampled ones, all drawn together.

    A training stands for all its seeds.
    """

    def __init__(self, evaluation: Evaluation, interval: str = INTERVALS[0]) -> None:
        self.evaluation, self._rows = evaluation, evaluation.rows(interval)
        self._resampler = Resampler(int(self._rows.sum()))
        self.mean = functools.cache(self._mean)
        self.drawn = functools.cache(self._drawn)

    def bounded(self, figure: Callable[[Look], Array]) -> Bounded:
        """Compute a figure from errors of trainings on domains, and its interval."""
        return Bounded.of(figure, self.mean, self.drawn)

    def _mean(self, training: TrainedModel, test: str) -> Array:
        return np.asarray(self._errors(training, test).mean(axis=(0, 1)))

    def _drawn(self, training: TrainedModel, test: str) -> Array:
        seeds = [run.seed for run in self.evaluation.runs(training)]
        return self._resampler.means(self._errors(training, test), f"{training.model} {seeds}")

    def _errors(self, training: TrainedModel, test: str) -> Array:
        return self.evaluation.errors(training, test)[:, self._rows]


def trainings_of(evaluation: Evaluation, model: str) -> list[TrainedModel]:
    """Give one run of each training of a model on all starts, in order.

    To leave one of two engines out is to train on the other.
    """
    by_domains: dict[tuple[str, ...], TrainedModel] = {}
    for run in evaluation.entries:
        if run.model == model and not run.interval:
            known = by_domains.setdefault(run.domains, run)
            if known.training not in run.domains and run.training in run.domains:
                by_domains[run.domains] = run
    return list(by_domains.values())


def singles_of(evaluation: Evaluation, model: str) -> list[TrainedModel]:
    """Give the trainings on one domain that is tested, too."""
    tested = {domain.name for domain in evaluation.test.domains}
    return [t for t in trainings_of(evaluation, model) if t.single and t.domains[0] in tested]


def kind_of(training: TrainedModel, test: str, every: Sequence[str]) -> str:
    """Give what a training is to a test domain; "" where there is no shift between them.

    Several engines' trainings count on engines that were left out, in either variant: what other
    settings of a known engine do, single ones show. `every` names all engine domains.
    """
    if training.single:
        return "" if test in training.domains else SINGLE
    own = {domain for domain in every if domain.endswith(f"-{training.variant}")}
    if own <= set(training.domains):
        return ALL
    return "" if test.rpartition("-")[0] in training.engines else LEAVE_ONE_OUT


def gaps_of(draws: Draws) -> Iterator[Gap]:
    """Give all gaps to models that were trained on the target."""
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
    """Say why a gap tells nothing of a shift; "" where it does.

    Given the error of the training on its own domain, the distance of its engine from the target's,
    both NaN where that is not tested, and the interval of the difference [m²].
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
    figures = {
        "own": own,
        "transferred": draws.mean(training, test),
        "target": draws.mean(target, test),
        "ratio": ratio.value,
        "ratio_low": ratio.low,
        "ratio_high": ratio.high,
        "difference": difference.value,
        "difference_low": difference.low,
        "difference_high": difference.high,
        "engine_floor": floor,
        **{
            f"{name}_floor": known_mean(evaluation.counted(evaluation.floors.get(name, unknown)))
            for name in ("noise", "chaos")
        },
    }
    return Gap(
        model=training.model,
        kind=kind,
        training=training.training,
        test=test,
        seeds=(len(evaluation.runs(training)), len(evaluation.runs(target))),
        **{name: values(figure) for name, figure in figures.items()},
        resolved=tuple(not reason for reason in why),
        why=why,
    )


def own_and_floor(draws: Draws, training: TrainedModel, test: str) -> tuple[Array, Array]:
    """R_ii and D_ij of the engine i of the training from which √R_ij ≤ √R_ii + √D_ij says most.

    Both are NaN where no other domain of the training is tested.
    """
    evaluation = draws.evaluation
    tested = {domain.name for domain in evaluation.test.domains}
    others = [n for n in training.domains if n in tested and (n, test) in evaluation.oracles]
    if not others:
        return (np.full(len(evaluation.frames), np.nan),) * 2
    own = np.stack([draws.mean(training, name) for name in others])
    floor = np.stack([evaluation.floor(name, test).mean(axis=0) for name in others])
    most = np.sqrt(own) + np.sqrt(floor)
    least = np.where(np.isnan(most), np.inf, most).argmin(axis=0)[None]
    return np.take_along_axis(own, least, 0)[0], np.take_along_axis(floor, least, 0)[0]


class Resampler:
    """Draws the same trajectories for every model and domain: what they share cancels.

    Runs of a seed share first weights and the order of windows, whatever they are trained on: seeds
    are drawn together, too.
    """

    def __init__(self, trajectories: int, *, draws: int = DRAWS, seed: int = _SEED) -> None:
        self._draws, self._seed = draws, seed
        self._weights = _weights(np.random.default_rng([seed]), draws, trajectories)

    def means(self, errors: Array, runs: str) -> Array:
        """Give resampled means (draw, frame) of finite errors (seed, trajectory, frame).

        Of the same name of runs the same seeds are drawn. Not numbers of one trajectory alone: by
        how much others would differ is not known.
        """
        if errors.shape[1] < _SEVERAL:
            return np.full((self._draws, errors.shape[2]), np.nan)
        rng = np.random.default_rng([self._seed, zlib.crc32(runs.encode())])
        seeds = _weights(rng, self._draws, len(errors))
        each = np.einsum("dt,stf->dsf", self._weights, errors, optimize=True)
        return np.einsum("ds,dsf->df", seeds, each)


def bounds_of(draws: Array) -> tuple[Array, Array]:
    """Central 95 % of draws, frame by frame; not a number where a draw is none."""
    tail = 0.5 * (1.0 - _LEVEL)
    low, high = np.quantile(draws, [tail, 1.0 - tail], axis=0)
    return low, high


def _weights(rng: np.random.Generator, draws: int, count: int) -> Array:
    """Draw one fewer than there are, so that means spread as those of new ones would.

    As many would take one part in `count` off their variance (Rao and Wu 1988, J. Am. Stat. Assoc.
    83, 231): little of a hundred trajectories, a third of three seeds.
    """
    drawn = max(count - 1, 1)
    return np.asarray(rng.multinomial(drawn, np.full(count, 1.0 / count), draws) / drawn)


def agreements_of(draws: Draws) -> Iterator[Agreement]:
    """Compare the orders of models that were trained where they are tested, and the paper's."""
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
    """Kendall's τ-b of the models that both have; None of fewer than three, or all ties."""
    both = [model for model in first if model in second]
    if len(both) < _LEAST:
        return None
    tau = float(kendalltau([first[m] for m in both], [second[m] for m in both]).statistic)
    return None if np.isnan(tau) else tau


def paper_errors(scene: str, *, flagged: bool = True) -> Errors:
    """Give the paper's printed errors of a scene at all speeds [m², if its unit is the metre].

    With `flagged` also those that a note says cannot be right as printed.
    """
    return {
        (row["model"].lower(), int(row["t"])): float(row["mean_si"])
        for row in paper_rows()
        if row["scenario"].replace("-", "").lower() == scene
        if not row["speed"] and (flagged or not row["note"])
    }


def paper_rows() -> list[dict[str, str]]:
    """Give what the paper's tables print, a row a figure."""
    text = resources.files("mbds_xsim.learn.shift").joinpath("paper.csv").read_text("utf-8")
    return list(csv.DictReader(text.splitlines()))


def _orders(draws: Draws) -> dict[str, Errors]:
    """Mean errors at home by domain."""
    evaluation, orders = draws.evaluation, dict[str, Errors]()
    for training in (t for model in evaluation.models for t in singles_of(evaluation, model)):
        home = training.domains[0]
        means = zip(evaluation.frames, draws.mean(training, home).tolist(), strict=True)
        orders.setdefault(home, {}).update({(training.model, f): x for f, x in means})
    return orders
