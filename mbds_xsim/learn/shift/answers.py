"""Answers in words, computed from the figures.

The cost of a change of engine is compared with that of a change of speed on one engine: a shift of
domains next to a shift of covariates, as in Koh et al., WILDS, ICML 2021.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.shift.evaluation import Evaluation
from mbds_xsim.learn.shift.gaps import (
    ALL,
    LEAVE_ONE_OUT,
    LONELY,
    SINGLE,
    UNKNOWN,
    UNSURE,
    WEAK,
    Bounded,
    Draws,
    Look,
    trainings_of,
)
from mbds_xsim.learn.shift.result import INTERVALS, Answer, BoundedRatio, Gap
from mbds_xsim.learn.trained import TrainedModel

RESOLVABLE, ROBUST, MATCHED, SPEED = "resolvable", "robust", "matched", "speed"
"""Kinds of answers, in addition to those that are named after a kind of training."""

_BLIND = (
    "where no gap is resolved, ratios tell how well trainings went, not what a change of engine "
    "does"
)
_ALONE = (
    "What a change of engine costs cannot be asked: no model was trained on two of the tested "
    "engines, each alone"
)
_PAIR = 2  # least number of engines of which one can be changed for another
_UNTOLD = f"this cannot be told: {_BLIND}"


@dataclass(frozen=True)
class _Trainings:
    """Trainings of one model in one variant, on domains of the variant."""

    model: str
    variant: str
    singles: dict[str, TrainedModel]
    """Single-engine trainings, by domain."""
    without: dict[str, TrainedModel]
    """Leave-one-out trainings, by the domain that is left out."""
    everything: TrainedModel | None


def answers_of(draws: Draws, gaps: Sequence[Gap], at: int) -> Iterator[Answer]:
    """Yield the answers at a frame that the available trainings allow."""
    evaluation = draws.evaluation
    place = evaluation.frames.index(at)
    variants = dict.fromkeys(domain.variant for domain in evaluation.test.domains)
    pairs = itertools.product(evaluation.models, variants)
    groups = [g for g in (_trainings(evaluation, *pair) for pair in pairs) if len(g.singles) > 1]
    yield _resolved(gaps, place, at)
    for variant in dict.fromkeys(group.variant for group in groups):
        yield _most_robust(draws, [g for g in groups if g.variant == variant], gaps, place)
    for group in groups:
        yield from _several_engines(draws, group, gaps, place)
    yield from _matched(draws, groups, gaps, place)


def _trainings(evaluation: Evaluation, model: str, variant: str) -> _Trainings:
    tests = [domain.name for domain in evaluation.test.domains if domain.variant == variant]
    trainings = [t for t in trainings_of(evaluation, model) if t.variant == variant]
    absent = {t: [n for n in tests if n not in t.domains] for t in trainings if not t.single}
    return _Trainings(
        model,
        variant,
        {t.domains[0]: t for t in trainings if t.single and t.domains[0] in tests},
        {names[0]: t for t, names in absent.items() if len(names) == 1},
        # If an engine is not tested, trainings that left it out have seen all domains, too.
        max((t for t, n in absent.items() if not n), key=lambda t: len(t.engines), default=None),
    )


def _resolved(gaps: Sequence[Gap], place: int, frame: int) -> Answer:
    """Answer how many shifts are resolvable at all."""
    single = [gap for gap in gaps if gap.kind == SINGLE]
    if not single:
        return Answer(RESOLVABLE, "Is a shift resolvable?", _ALONE)
    count = Counter(gap.why[place] for gap in single)
    resolved = [gap for gap in single if gap.resolved[place]]
    worse = [gap for gap in resolved if (gap.difference[place] or 0.0) >= 0.0]
    text = (
        f"At t = {frame}, {len(resolved)} of {len(single)} shifts from one engine's data to "
        f"another's are resolved{_by_settings(single, place)}. In {len(worse)} of them the model "
        f"errs more than the one trained there{_no_harm(worse, place)}, in "
        f"{len(resolved) - len(worse)} less. Not resolved are {count[WEAK]} because the model's "
        f"own error exceeds the engine floor, {count[UNSURE]} because the interval of the "
        "difference contains 0"
    )
    if count[LONELY]:
        text += f", {count[LONELY]} because one trajectory gives no interval"
    if count[UNKNOWN]:
        text += f", {count[UNKNOWN]} because the model's own domain is not tested"
    tried = len(resolved) + count[UNSURE]
    if tried > 1:
        text += f". By chance alone {0.05 * tried:.2g} of {tried} intervals of 95 % would miss 0"
    return Answer(RESOLVABLE, "Is a shift resolvable?", text)


def _by_settings(gaps: Sequence[Gap], place: int) -> str:
    """Count changes of engine and of settings separately, if there are both."""
    same = [g for g in gaps if g.training.rpartition("-")[2] == g.test.rpartition("-")[2]]
    others = [gap for gap in gaps if gap not in same]
    if not others:
        return ""
    return (
        f" ({_count_resolved(same, place)} at the same settings, "
        f"{_count_resolved(others, place)} from other settings)"
    )


def _no_harm(worse: Sequence[Gap], place: int) -> str:
    """Count models that lose nothing by the change, but are worse than the target's own."""
    # Errors behind a resolved gap are known.
    count = sum((gap.transferred[place] or 0.0) <= (gap.own[place] or 0.0) for gap in worse)
    return f" (in {count} of these no more than at home: its data teach less)" if count else ""


def _most_robust(
    draws: Draws, groups: Sequence[_Trainings], gaps: Sequence[Gap], place: int
) -> Answer:
    """Find the model with the smallest worst-engine gap, among those with a resolved shift."""
    frame, variant = draws.evaluation.frames[place], groups[0].variant
    within = {group.model: _gaps_within(group, group.singles, gaps) for group in groups}
    resolved = {model: [g for g in own if g.resolved[place]] for model, own in within.items()}
    judged = {model: own or within[model] for model, own in resolved.items()}
    ratios = {
        group.model: draws.bounded(functools.partial(_worst_gap, group, judged[group.model]))
        for group in groups
    }
    ordered = {m: ratios[m] for m in sorted(ratios, key=lambda model: ratios[model].value[place])}
    able = [model for model in ordered if resolved[model]]
    parts = ", ".join(f"{len(resolved[m])} of {len(own)} of {m}" for m, own in within.items())
    text = (
        f"At t = {frame} on {variant} data {_first(able, ordered, place)}. Gaps resolved: "
        f"{parts}. Largest error over that of the model trained on the test engine, of the "
        "resolved gaps, else of all (the largest of several is above 1 even without a shift): "
        f"{_texts(ordered, place)}"
    )
    question = f"Which model is most robust ({variant})?"
    return Answer(ROBUST, question, text, variant, _results(ratios))


def _first(able: Sequence[str], ratios: Mapping[str, Bounded], place: int) -> str:
    """Name the first of the models with a resolved shift, and say how sure that is."""
    if not able:
        return _UNTOLD
    best, others = ratios[able[0]], able[1:]
    near = [model for model in others if ratios[model].low[place] <= best.high[place]]
    sure = f"its interval overlaps those of {', '.join(near)}" if near else "apart from all others"
    text = f"{able[0]} has the smallest worst-engine gap" + (f" ({sure})" if others else "")
    blind = [model for model in ratios if model not in able]
    return f"{text}; {', '.join(blind)} cannot be judged: {_BLIND}" if blind else text


def _gaps_within(
    group: _Trainings, trainings: Mapping[str, TrainedModel], gaps: Sequence[Gap]
) -> list[Gap]:
    """Return the gaps of some of a group's trainings to domains of its variant."""
    names = {training.training for training in trainings.values()}
    own = [gap for gap in gaps if gap.model == group.model and gap.training in names]
    return [gap for gap in own if gap.test in group.singles]


def _count_resolved(gaps: Sequence[Gap], place: int) -> str:
    return f"{sum(gap.resolved[place] for gap in gaps)} of {len(gaps)}"


def _worst_gap(group: _Trainings, gaps: Sequence[Gap], look: Look) -> Array:
    """Compute the largest ratio to the target-trained model."""
    singles = {training.training: training for training in group.singles.values()}
    ratios = [
        _over(look(singles[gap.training], gap.test), look(group.singles[gap.test], gap.test))
        for gap in gaps
    ]
    return np.asarray(np.max(ratios, axis=0))


def _mean_gap(group: _Trainings, look: Look) -> Array:
    """Compute the geometric mean of the ratios to the target-trained model."""
    singles = group.singles
    pairs = itertools.permutations(singles, 2)
    return _geometric([_over(look(singles[i], j), look(singles[j], j)) for i, j in pairs])


def _several_engines(
    draws: Draws, group: _Trainings, gaps: Sequence[Gap], place: int
) -> Iterator[Answer]:
    model, variant, singles = group.model, group.variant, group.singles
    at, everything = f"At t = {draws.evaluation.frames[place]}", group.everything
    shared = [name for name in group.without if name in singles]

    def left_out(look: Look) -> Array:
        """Compute the error without the target over that of single others, as geometric means."""
        ratios = []
        for test in shared:
            others = [look(t, test) for name, t in singles.items() if name != test]
            ratios.append(_over(look(group.without[test], test), _geometric(others)))
        return _geometric(ratios)

    def worst_of_all(look: Look) -> Array:
        """Compute the worst error of the all-engine training over the mean worst of single ones."""
        assert everything is not None
        worst, *each = (
            np.max([look(t, test) for test in singles], axis=0)
            for t in (everything, *singles.values())
        )
        return _over(worst, _geometric(each))

    if shared:
        ratio = draws.bounded(left_out)
        parts = _count_resolved(_gaps_within(group, group.without, gaps), place)
        text = (
            f"{at} leaving one engine out {ratio.verdict(place)} on the engine left out, against "
            f"training on a single other engine: error ratio {ratio.text(place)}. Of the gaps of "
            f"these trainings to the target-trained model {parts} are resolved"
        )
        question = f"Does training on several others help {model} ({variant})?"
        yield Answer(LEAVE_ONE_OUT, question, text, variant, _results({model: ratio}))
    if everything is not None:
        ratio = draws.bounded(worst_of_all)
        text = (
            f"{at} training on all engines {ratio.verdict(place)} on the worst engine, against "
            f"single-engine trainings on their worst: error ratio {ratio.text(place)}"
        )
        question = f"Does training on all engines help {model} ({variant})?"
        yield Answer(ALL, question, text, variant, _results({model: ratio}))


def _matched(
    draws: Draws, groups: Sequence[_Trainings], gaps: Sequence[Gap], place: int
) -> Iterator[Answer]:
    """Compare the mean gaps of a model between variants, over the engines that both have."""
    frame = draws.evaluation.frames[place]
    for model in dict.fromkeys(group.model for group in groups):
        variants = {group.variant: group for group in groups if group.model == model}
        if not {"native", "matched"} <= set(variants):
            continue
        either = {name for v in ("native", "matched") for name in _engines(variants[v])}
        variants = _of_common_engines(variants["native"], variants["matched"])
        common = _engines(variants["native"])
        if len(common) < _PAIR:
            continue
        among = f" between {', '.join(sorted(common))}" if common < either else ""
        native, matched = (
            draws.bounded(functools.partial(_mean_gap, variants[v])) for v in ("native", "matched")
        )
        change = draws.bounded(functools.partial(_lessening, variants))
        within = {name: _gaps_within(g, g.singles, gaps) for name, g in variants.items()}
        text = (
            f"At t = {frame}{among} {_removal(native, matched, change, within, place)}. "
            f"Mean gap ratio: native {native.text(place)}, matched {matched.text(place)}, native "
            f"over matched {change.text(place)}"
        )
        question = f"Does matched data remove the shift of {model}?"
        yield Answer(MATCHED, question, text, ratios=_results({model: change}))


def _engines(group: _Trainings) -> set[str]:
    """Return the engines on which alone a model was trained."""
    return {name.rpartition("-")[0] for name in group.singles}


def _of_common_engines(*groups: _Trainings) -> dict[str, _Trainings]:
    """Return the groups by variant, each with its trainings on the engines that all have alone."""
    common = set.intersection(*map(_engines, groups))
    return {
        group.variant: dataclasses.replace(
            group,
            singles={n: t for n, t in group.singles.items() if n.rpartition("-")[0] in common},
        )
        for group in groups
    }


def _lessening(variants: Mapping[str, _Trainings], look: Look) -> Array:
    """Compute the mean gap on native data over that on matched data, for the same trajectories."""
    return _over(_mean_gap(variants["native"], look), _mean_gap(variants["matched"], look))


def _removal(
    native: Bounded, matched: Bounded, change: Bounded, gaps: dict[str, list[Gap]], place: int
) -> str:
    """Distinguish a removed shift from one that matched data's interval is too wide to show."""
    if np.isnan(native.low[place]):
        return _UNTOLD
    if not native.low[place] > 1.0:
        return "native data show no shift that matched data could remove"
    if not any(gap.resolved[place] for gap in gaps["native"]):
        return _UNTOLD
    less = change.low[place] > 1.0
    there = matched.low[place] > 1.0
    if there and any(gap.resolved[place] for gap in gaps["matched"]):
        return "matched data lessen the shift" if less else "the shift is there on matched data too"
    if not less:
        return "whether matched data remove the shift cannot be told"
    near = all(gap.why[place] == WEAK for gap in gaps["matched"])
    why = ", whose engines differ by less than the model errs" if near else ""
    return f"no shift is {'resolved' if there else 'left'} on matched data{why}"


def answers_by_interval(evaluation: Evaluation, at: int) -> Iterator[Answer]:
    """Yield an answer for every domain on which models were trained on each interval alone."""
    speeds = INTERVALS[1:]
    if not all(evaluation.rows(interval).any() for interval in speeds):
        return
    place = evaluation.frames.index(at)
    draws = {interval: Draws(evaluation, interval) for interval in speeds}
    trained: dict[tuple[str, str], dict[str, TrainedModel]] = {}
    for run in evaluation.entries:
        if run.interval:
            trained.setdefault((run.model, run.domains[0]), {}).setdefault(run.interval, run)
    for domain in evaluation.test.domains:
        ratios = {
            model: _worst_speed(draws, own, domain.name)
            for model in evaluation.models
            if len(own := trained.get((model, domain.name), {})) == len(speeds)
        }
        if ratios:
            text = (
                f"At t = {at} on {domain.name}, a model that was trained on the starts of another "
                "interval of speed has so many times the error of the one that was trained on the "
                f"interval tested, in the worst pair of three intervals: {_texts(ratios, place)}"
            )
            question = f"What does a change of speed cost ({domain.name})?"
            yield Answer(SPEED, question, text, domain.variant, _results(ratios))


def _worst_speed(
    draws: Mapping[str, Draws], trained: Mapping[str, TrainedModel], domain: str
) -> Bounded:
    """Compute the largest ratio of errors on an interval: trained on another over trained on it."""

    def worst(look: str) -> Array:
        error = {
            (run, tested): getattr(draws[tested], look)(trained[run], domain)
            for run, tested in itertools.product(trained, repeat=2)
        }
        pairs = itertools.permutations(trained, 2)
        return np.asarray(np.max([error[a, b] / error[b, b] for a, b in pairs], axis=0))

    return Bounded.of(worst, "mean", "drawn")


def _texts(ratios: Mapping[str, Bounded], place: int) -> str:
    return ", ".join(f"{model} {ratio.text(place)}" for model, ratio in ratios.items())


def _results(ratios: Mapping[str, Bounded]) -> dict[str, BoundedRatio]:
    return {model: BoundedRatio(**ratio.rounded()) for model, ratio in ratios.items()}


def _over(here: Array, there: Array) -> Array:
    """Divide, with 1 for 0 / 0: two perfect models do not differ."""
    return np.asarray(np.where((here == 0.0) & (there == 0.0), 1.0, here / there))


def _geometric(figures: Sequence[Array]) -> Array:
    return np.asarray(np.exp(np.mean(np.log(figures), axis=0)))
