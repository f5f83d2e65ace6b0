"""Do training and test engine belong together? The interaction of the two.

The error R_ij of a model that was trained on engine i and is tested on j has three causes: how well
the training on i went, how hard j is, and whether i's data are like j's. For two engines the first
two cancel in

    x_ij = √( R_ij R_ji / (R_ii R_jj) ),

the interaction in a table of two factors whose effects multiply, as an odds ratio is for counts
(Fienberg 1980, The Analysis of Cross-Classified Categorical Data, chapter 2). x = 1 means that the
change costs nothing, x = 2 that it doubles the squared error, as a geometric mean of both
directions. It needs no engine floor: a poor model only pulls x towards 1.

Among many pairs some seem to differ by chance. A pair is resolved if the rule of Benjamini and
Hochberg (1995, J. R. Stat. Soc. B 57, 289) keeps it, at each frame among all pairs of a study: one
in twenty of these may be due to chance.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeVar

import msgspec
import numpy as np
from scipy.stats import false_discovery_control, t

from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.shift.gaps import Bounded, Draws, Look, own_and_floor, singles_of
from mbds_xsim.learn.shift.result import Answer, Interaction, PairRatio
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.report.quantity import ratio as ratio_text

Ratio = Callable[[TrainedModel, TrainedModel, Look], Array]
"""Function that computes a ratio of errors of two trainings."""
Made = TypeVar("Made", bound=PairRatio)

INTERACTION = "interaction"
"""Kind of answer."""
FALSE = 0.05
"""Share of the resolved pairs that may be due to chance."""
_ROUNDING = 1e-9  # of a logarithm
BEARABLE = 2.0
"""Ratio of squared errors below which a model survives a change."""
_SEVERAL = 2  # least number of changes to put side by side
OTHER = {"engine": "another engine", "settings": "other settings"}
"""Words for each kind of change."""


def interactions_of(draws: Draws) -> tuple[Interaction, ...]:
    """Return the interactions of engines at the same settings, and of settings of one engine.

    A pair needs a model that was trained on each of the two alone.
    """
    pairs = list(_pairs(draws))
    interactions = compared(draws, pairs, interaction, Interaction)
    return tuple(
        msgspec.structs.replace(each, noticed=_noticed(draws, *pair))
        for each, pair in zip(interactions, pairs, strict=True)
    )


def _noticed(draws: Draws, first: TrainedModel, second: TrainedModel) -> tuple[bool, ...]:
    """Return whether the error of either training at home is less than the domains' distance."""
    directions = ((first, second.domains[0]), (second, first.domains[0]))
    errors = [own_and_floor(draws, *direction) for direction in directions]
    return tuple(np.any([own < floor for own, floor in errors], axis=0).tolist())


def compared(
    draws: Draws,
    pairs: Sequence[tuple[TrainedModel, TrainedModel]],
    ratio: Ratio,
    kind: type[Made],
) -> tuple[Made, ...]:
    """Bound a ratio of errors for pairs of trainings, and find which are significant together."""
    ratios = [partial(ratio, *pair) for pair in pairs]
    bounded = [draws.bounded(each) for each in ratios]
    seeds = [min(len(draws.evaluation.runs(each)) for each in pair) for pair in pairs]
    chances = [_chance(draws, *each) for each in zip(ratios, bounded, seeds, strict=True)]
    resolved = _kept(np.array(chances)).tolist() if chances else []
    return tuple(
        kind(
            model=first.model,
            first=first.domains[0],
            second=second.domains[0],
            seeds=count,
            **bounds.rounded(),
            resolved=tuple(row),
        )
        for (first, second), count, bounds, row in zip(pairs, seeds, bounded, resolved, strict=True)
    )


def _chance(draws: Draws, ratio: Callable[[Look], Array], bounded: Bounded, seeds: int) -> Array:
    """Compute the p-value of the ratio's logarithm, from its spread over the draws."""
    with np.errstate(divide="ignore", invalid="ignore"):
        whole, part = (np.log(ratio(look)).var(axis=0) for look in (draws.drawn, draws.reseeded))
        size = np.abs(np.log(bounded.value)) / (np.sqrt(whole) + _ROUNDING)
        share = np.where(part > 0.0, np.minimum(part / whole, 1.0), 0.0)
        return chance_beyond(size, share, seeds, len(draws.evaluation.test.index))


def chance_beyond(size: Array, share: Array, seeds: int, trajectories: int) -> Array:
    """Return the chance that a mean is off by more than `size` of its standard deviations.

    Seeds bring a `share` of its variance, trajectories the rest. The spread of three seeds is known
    roughly only, for which Student's t allows. Its t has the weight of its tail in the distribution
    of Behrens and Fisher (1935, Ann. Eugenics 6, 391), that of the trajectories the rest.
    Satterthwaite's degrees of freedom would be too many where few seeds show less spread by chance
    than they have.
    """
    few, many = max(seeds - 1, 1), max(trajectories - 1, 1)
    weight = share ** (0.5 * few)
    return np.asarray(2.0 * (weight * t.sf(size, few) + (1.0 - weight) * t.sf(size, many)))


def interaction(first: TrainedModel, second: TrainedModel, look: Look) -> Array:
    """Compute √(R_ij R_ji / (R_ii R_jj)) of two trainings, each on one engine."""
    i, j = first.domains[0], second.domains[0]
    return np.asarray(np.sqrt(look(first, j) / look(second, j) * look(second, i) / look(first, i)))


def _pairs(draws: Draws) -> Iterator[tuple[TrainedModel, TrainedModel]]:
    for model in draws.evaluation.models:
        singles = singles_of(draws.evaluation, model)
        for first, second in itertools.combinations(singles, 2):
            if changed(first.domains[0], second.domains[0]):
                yield first, second


def changed(first: str, second: str) -> tuple[str, str] | None:
    """Return what differs between two domains, and where; None if both engine and settings do."""
    engine, _, variant = first.rpartition("-")
    other_engine, _, other_variant = second.rpartition("-")
    if variant == other_variant:
        return "engine", f"on {variant} data"
    return ("settings", f"in {engine}") if engine == other_engine else None


def _kept(chances: Array) -> Array:
    """Return which pairs are significant, frame by frame, shape (pair, frame)."""
    resolved = np.zeros(chances.shape, dtype=bool)
    for frame, column in enumerate(chances.T):
        known = np.flatnonzero(np.isfinite(column))
        if len(known):
            resolved[known, frame] = false_discovery_control(column[known]) < FALSE
    return resolved


def answers_of_interactions(
    interactions: Sequence[Interaction], place: int, frame: int, since: str = ""
) -> Iterator[Answer]:
    """Yield an answer for each change of engine or settings: its cost to each model.

    `since` says from where frames are counted, if not from the last known one.
    """
    for (change, context), own in by_change(interactions).items():
        models = dict.fromkeys(each.model for each in own)
        parts = [_told([e for e in own if e.model == model], model, place) for model in models]
        question = f"What does a change of {change} cost {context}{since}?"
        yield Answer(INTERACTION, question, f"At t = {frame}{since} {context} {'; '.join(parts)}")


def answer_of_factors(
    interactions: Sequence[Interaction], place: int, frame: int, since: str = ""
) -> Iterator[Answer]:
    """Put the costs of all changes side by side, if there are several, as far as they are known."""
    changes = by_change(interactions)
    if len(changes) < _SEVERAL:
        return
    *others, last = dict.fromkeys(each.model for each in interactions)
    models = " and ".join([*filter(None, [", ".join(others)]), last])
    error, (dear, cheap, untold) = f"the squared error of {models}", _by_cost(changes, place)
    parts = [f"significantly by up to {', '.join(dear)}"] if dear else []
    parts += [f"less than {BEARABLE:g}-fold, if at all, {', '.join(cheap)}"] if cheap else []
    if not parts:
        text = f"it cannot be told by how much {error} grows {', '.join(untold)}"
    else:
        parts += [f"by how much cannot be told {', '.join(untold)}"] if untold else []
        text = f"{error} grows {'; '.join(parts)}"
    question = f"Which change costs how much{since}?"
    yield Answer(INTERACTION, question, f"At t = {frame}{since} {text}")


def _by_cost(
    changes: Mapping[tuple[str, str], Sequence[Interaction]], place: int
) -> tuple[list[str], list[str], list[str]]:
    """Name the changes that are dear, cheap, or of unknown cost, each in order of cost.

    A change is dear by a significant pair, and cheap if the intervals of all its pairs are below
    `BEARABLE`.
    """
    dear, cheap, untold = list[str](), list[str](), list[str]()
    for (change, context), own in sorted(changes.items(), key=lambda each: -_most(each[1], place)):
        words, most = f"with {OTHER[change]} {context}", _most(own, place)
        highs = [each.high[place] for each in own]
        if most >= BEARABLE:
            dear.append(f"{_times(most)} {words}")
            continue
        below = all(high is not None and high < BEARABLE for high in highs)
        known = f" (significant: {_times(most)})" if most > 1.0 else ""
        (cheap if below else untold).append(f"{words}{known}")
    return dear, cheap, untold


def by_change(interactions: Sequence[Interaction]) -> dict[tuple[str, str], list[Interaction]]:
    """Group interactions by what differs, first "engine" and then "settings", and by where."""
    changes: dict[tuple[str, str], list[Interaction]] = {}
    for each in interactions:
        change = changed(each.first, each.second)
        if change is not None:
            changes.setdefault(change, []).append(each)
    kinds = list(OTHER)
    return dict(sorted(changes.items(), key=lambda change: kinds.index(change[0][0])))


def _times(value: float) -> str:
    """Format a significant ratio as 8.32-fold or 1.002-fold."""
    return f"{ratio_text(value, significant=True)}-fold"


def _most(own: Sequence[Interaction], place: int) -> float:
    """Return the largest of the significant interactions, or 1."""
    return max((each.value[place] or 1.0 for each in own if each.resolved[place]), default=1.0)


def _told(own: Sequence[Interaction], model: str, place: int) -> str:
    known = [each for each in own if each.value[place] is not None]
    losses = [each for each in known if each.resolved[place] and (each.value[place] or 0.0) > 1.0]
    if not known:
        return f"{model} has errors of 0"
    if not losses:
        mean = statistics.geometric_mean(each.value[place] or 1.0 for each in known)
        return (
            f"{model} loses nothing that can be told, {mean:.3g} times the squared error on "
            f"average (pairs: {len(own)})"
        )
    most = max(losses, key=lambda each: each.value[place] or 0.0)
    figures = (most.value[place], most.low[place], most.high[place])
    value, low, high = (ratio_text(figure, significant=True) for figure in figures)
    return (
        f"{model} loses in {len(losses)} of {len(own)} pairs, at most {value} [{low}, {high}] "
        f"times the squared error, between {most.first} and {most.second}"
    )
