"""Do training and test engine belong together? The interaction of the two.

The error R_ij of a model that was trained on engine i and is tested on j has three causes: how well
the training on i went, how hard j is, and whether i's data are like j's. Of two engines the first
two cancel in

    x_ij = √( R_ij R_ji / (R_ii R_jj) ),

the interaction in a table of two factors whose effects multiply, as an odds ratio is that of counts
(Fienberg 1980, The Analysis of Cross-Classified Categorical Data, chapter 2). 1 is no loss by the
change, 2 twice the squared error, whichever way one goes. It needs no engine floor: where a model
is poor x is near 1, and that is what is told.

Of many pairs some seem to differ by chance. Resolved are those that the rule of Benjamini and
Hochberg (1995, J. R. Stat. Soc. B 57, 289) keeps, at each frame among all pairs of a study: of
these one in twenty may be chance.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeVar

import msgspec
import numpy as np
from scipy.stats import false_discovery_control, norm

from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.shift.gaps import Bounded, Draws, Look, own_and_floor, singles_of
from mbds_xsim.learn.shift.result import Answer, Interaction, PairRatio, values
from mbds_xsim.learn.trained import TrainedModel

Ratio = Callable[[TrainedModel, TrainedModel, Look], Array]
"""Of errors of two trainings."""
Made = TypeVar("Made", bound=PairRatio)

INTERACTION = "interaction"
"""Kind of answer."""
FALSE = 0.05
"""Share of the resolved that may be chance."""
_ROUNDING = 1e-9  # of a logarithm
BEARABLE = 2.0
"""Times the squared error: less is called survived."""
_SEVERAL = 2  # changes that are put side by side
OTHER = {"engine": "another engine", "settings": "other settings"}
"""Words for changes."""


def interactions_of(draws: Draws) -> tuple[Interaction, ...]:
    """Give those of all pairs of engines at the same settings, and of settings of one engine.

    Each pair of a model that was trained on both, on each alone.
    """
    pairs = list(_pairs(draws))
    found = compared(draws, pairs, interaction, Interaction)
    return tuple(
        msgspec.structs.replace(each, noticed=_noticed(draws, *pair))
        for each, pair in zip(found, pairs, strict=True)
    )


def _noticed(draws: Draws, first: TrainedModel, second: TrainedModel) -> tuple[bool, ...]:
    """Whether one of two trainings, each on one domain, errs less there than both are apart."""
    ways = ((first, second.domains[0]), (second, first.domains[0]))
    errors = [own_and_floor(draws, *way) for way in ways]
    return tuple(np.any([own < floor for own, floor in errors], axis=0).tolist())


def compared(
    draws: Draws,
    pairs: Sequence[tuple[TrainedModel, TrainedModel]],
    ratio: Ratio,
    kind: type[Made],
) -> tuple[Made, ...]:
    """Bound a ratio of errors for pairs of trainings; tell which are no chance, of all together."""
    ratios = [partial(ratio, *pair) for pair in pairs]
    bounded = [draws.bounded(each) for each in ratios]
    chances = [_chance(draws, *each) for each in zip(ratios, bounded, strict=True)]
    kept = _kept(np.array(chances)).tolist() if chances else []
    return tuple(
        kind(
            model=first.model,
            first=first.domains[0],
            second=second.domains[0],
            seeds=min(len(draws.evaluation.runs(each)) for each in (first, second)),
            value=values(bounds.value),
            low=values(bounds.low),
            high=values(bounds.high),
            resolved=tuple(row),
        )
        for (first, second), bounds, row in zip(pairs, bounded, kept, strict=True)
    )


def _chance(draws: Draws, ratio: Callable[[Look], Array], bounded: Bounded) -> Array:
    """Compute how probable so large a logarithm would be where there is none, by its spread."""
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.log(ratio(draws.drawn)).std(axis=0) + _ROUNDING
        return np.asarray(2.0 * norm.sf(np.abs(np.log(bounded.value)) / spread))


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
    """Say what differs between two domains, and where, if it is one thing alone."""
    engine, _, variant = first.rpartition("-")
    other_engine, _, other_variant = second.rpartition("-")
    if variant == other_variant:
        return "engine", f"on {variant} data"
    return ("settings", f"in {engine}") if engine == other_engine else None


def _kept(chances: Array) -> Array:
    """Tell which pairs are no chance, frame by frame, (pair, frame)."""
    kept = np.zeros(chances.shape, dtype=bool)
    for frame, column in enumerate(chances.T):
        known = np.flatnonzero(np.isfinite(column))
        if len(known):
            kept[known, frame] = false_discovery_control(column[known]) < FALSE
    return kept


def answers_of_interactions(
    found: Sequence[Interaction], place: int, frame: int, since: str = ""
) -> Iterator[Answer]:
    """Say of each change, of engine or settings, what it costs whatever else differs.

    `since` are words for where frames are counted from, if not from the last known one.
    """
    for (change, where), own in by_change(found).items():
        models = dict.fromkeys(each.model for each in own)
        parts = [_told([e for e in own if e.model == model], model, place) for model in models]
        question = f"What does a change of {change} cost {where}{since}?"
        yield Answer(INTERACTION, question, f"At t = {frame}{since} {where} {'; '.join(parts)}")


def answer_of_factors(
    found: Sequence[Interaction], place: int, frame: int, since: str = ""
) -> Iterator[Answer]:
    """Put the largest costs of all changes side by side, where there are several."""
    changes = by_change(found)
    if len(changes) < _SEVERAL:
        return
    costs = {
        f"with {OTHER[change]} {where}": _most(whole, place)
        for (change, where), whole in changes.items()
    }
    ranked = sorted(costs.items(), key=lambda cost: -cost[1])
    dear = ", ".join(f"{_times(most)} {words}" for words, most in ranked if most >= BEARABLE)
    cheap = ", ".join(words for words, most in ranked if most < BEARABLE)
    told = [f"at most {dear}"] if dear else []
    told += [f"less than {BEARABLE:g}-fold, if at all, {cheap}"] if cheap else []
    *others, last = dict.fromkeys(each.model for each in found)
    models = " and ".join([*filter(None, [", ".join(others)]), last])
    text = f"At t = {frame}{since} the squared error of {models} grows {'; '.join(told)}"
    yield Answer(INTERACTION, f"Which change costs how much{since}?", text)


def by_change(found: Sequence[Interaction]) -> dict[tuple[str, str], list[Interaction]]:
    """Group them by what differs, first "engine" and then "settings", and where it does."""
    changes: dict[tuple[str, str], list[Interaction]] = {}
    for each in found:
        change = changed(each.first, each.second)
        if change is not None:
            changes.setdefault(change, []).append(each)
    kinds = list(OTHER)
    return dict(sorted(changes.items(), key=lambda change: kinds.index(change[0][0])))


def _times(value: float) -> str:
    """Write 8.32-fold or 1021-fold."""
    return f"{value:.3g}-fold" if value < 1000.0 else f"{value:.0f}-fold"


def _most(own: Sequence[Interaction], place: int) -> float:
    """The largest of those interactions that are significant, or 1."""
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
    value, low, high = (getattr(most, name)[place] for name in ("value", "low", "high"))
    return (
        f"{model} loses in {len(losses)} of {len(own)} pairs, at most "
        f"{value:.3g} [{low:.3g}, {high:.3g}] times the squared error, between {most.first} and "
        f"{most.second}"
    )
