"""Answers in words, computed from the figures."""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.learn.shift.board import Board
from mbds_xsim.learn.shift.bootstrap import bounds_of
from mbds_xsim.learn.shift.gaps import (
    ALL,
    LEAVE_ONE_OUT,
    SINGLE,
    UNKNOWN,
    UNSURE,
    WEAK,
    Draws,
    Training,
    trainings_of,
)
from mbds_xsim.learn.shift.result import Answer, Gap, Ratio, values

__all__ = ["MATCHED", "ROBUST", "answers_of"]

RESOLVABLE, ROBUST, MATCHED = "resolvable", "robust", "matched"
"""Kinds of answers beside those that are named after a kind of training."""

_BLIND = (
    "where no gap is resolved, ratios tell how well trainings went, not what a change of engine "
    "does"
)
_ALONE = "This cannot be asked: no model was trained on two of the tested engines, each alone"
_UNTOLD = f"this cannot be told: {_BLIND}"

Array = NDArray[np.float64]
Look = Callable[[Training, str], Array]
"""Errors of a training on a domain: means (frame,), or resampled ones (draw, frame)."""


@dataclass(frozen=True)
class _Ratio:
    """A figure of 1 where nothing changes, with its interval, at the frames."""

    value: Array
    low: Array
    high: Array

    def told(self, place: int) -> str:
        return f"{self.value[place]:.3g} [{self.low[place]:.3g}, {self.high[place]:.3g}]"

    def verdict(self, place: int, less: str, more: str, same: str) -> str:
        if self.high[place] < 1.0:
            return less
        return more if self.low[place] > 1.0 else same

    @property
    def result(self) -> Ratio:
        return Ratio(values(self.value), values(self.low), values(self.high))


@dataclass(frozen=True)
class _Field:
    """Trainings of one model in one variant, and the domains of the variant."""

    model: str
    variant: str
    singles: dict[str, Training]
    """By the domain."""
    without: dict[str, Training]
    """Leave-one-out trainings, by the domain that is left out."""
    everything: Training | None


def answers_of(board: Board, draws: Draws, gaps: Sequence[Gap], at: int) -> Iterator[Answer]:
    """Answer what can be answered at a frame from the trainings that there are."""
    place = board.frames.index(at)
    fields = [f for f in _fields(board) if len(f.singles) > 1]
    yield _resolved(gaps, place, board.frames[place])
    for variant in dict.fromkeys(field.variant for field in fields):
        yield _most_robust(draws, [f for f in fields if f.variant == variant], gaps, place)
    for field in fields:
        yield from _several_engines(draws, field, gaps, place)
    yield from _matched(draws, fields, gaps, place)


def _fields(board: Board) -> list[_Field]:
    variants = dict.fromkeys(domain.variant for domain in board.test.domains)
    return [_field(board, *pair) for pair in itertools.product(board.models, variants)]


def _field(board: Board, model: str, variant: str) -> _Field:
    tests = [domain.name for domain in board.test.domains if domain.variant == variant]
    trainings = [t for t in trainings_of(board, model) if t.variant == variant]
    singles = {t.domains[0]: t for t in trainings if len(t.engines) == 1}
    several = [t for t in trainings if len(t.engines) > 1]
    absent = {t: [name for name in tests if name not in t.domains] for t in several}
    return _Field(
        model,
        variant,
        {name: t for name, t in singles.items() if name in tests},
        {names[0]: t for t, names in absent.items() if len(names) == 1},
        # Without tests of some engine, those that left it out have seen all domains, too.
        max((t for t, n in absent.items() if not n), key=lambda t: len(t.engines), default=None),
    )


def _resolved(gaps: Sequence[Gap], place: int, frame: int) -> Answer:
    """How many shifts can be told at all."""
    single = [gap for gap in gaps if gap.kind == SINGLE]
    if not single:
        return Answer(RESOLVABLE, "Is a shift resolvable?", _ALONE)
    count = Counter(gap.why[place] for gap in single)
    told = [gap for gap in single if not gap.why[place]]
    better = sum(_is_gain(gap, place) for gap in told)
    text = (
        f"At t = {frame}, {len(told)} of {len(single)} shifts from one engine's data to another's "
        f"are resolved{_by_settings(single, place)}: {len(told) - better} times the model errs "
        f"more than the one trained there{_no_harm(told, place)}, {better} times less; "
        f"{count[WEAK]} are not because the model's own error exceeds the engine floor, "
        f"{count[UNSURE]} because the interval of the difference contains 0"
    )
    if count[UNKNOWN]:
        text += f", {count[UNKNOWN]} because the model's own domain is not tested"
    tried = len(told) + count[UNSURE]
    if tried > 1:
        text += f". Of {tried} intervals at 95 % each, {0.05 * tried:.2g} miss 0 without a shift"
    return Answer(RESOLVABLE, "Is a shift resolvable?", text)


def _by_settings(gaps: Sequence[Gap], place: int) -> str:
    """Tell changes of engine from those of settings, where there are both."""
    same = [gap for gap in gaps if _variant_of(gap.training) == _variant_of(gap.test)]
    others = [gap for gap in gaps if gap not in same]
    if not others:
        return ""
    return (
        f" ({_count_resolved(same, place)} at the same settings, "
        f"{_count_resolved(others, place)} from other settings)"
    )


def _variant_of(domain: str) -> str:
    return domain.rpartition("-")[2]


def _no_harm(told: Sequence[Gap], place: int) -> str:
    """Count models that lose nothing by the change, and yet err more than the target's own."""
    worse = [gap for gap in told if not _is_gain(gap, place)]
    none = sum(_not_above(gap.transferred[place], gap.own[place]) for gap in worse)
    return f" (in {none} of these no more than at home: its data teach less)" if none else ""


def _not_above(here: float | None, there: float | None) -> bool:
    return here is not None and there is not None and here <= there


def _is_gain(gap: Gap, place: int) -> bool:
    difference = gap.difference[place]
    return difference is not None and difference < 0.0


def _most_robust(draws: Draws, fields: Sequence[_Field], gaps: Sequence[Gap], place: int) -> Answer:
    """The model of the smallest worst-engine gap, of those in which a shift can be seen."""
    frame, variant = draws.board.frames[place], fields[0].variant
    seen = {field.model: _gaps_within(field, field.singles, gaps) for field in fields}
    resolved = {model: [g for g in own if g.resolved[place]] for model, own in seen.items()}
    ratios = {
        f.model: _ratio(draws, functools.partial(_worst_gap, f, resolved[f.model] or seen[f.model]))
        for f in fields
    }
    order = sorted(ratios, key=lambda model: ratios[model].value[place])
    told = ", ".join(f"{model} {ratios[model].told(place)}" for model in order)
    able = [model for model in order if resolved[model]]
    parts = ", ".join(f"{len(resolved[m])} of {len(own)} of {m}" for m, own in seen.items())
    text = (
        f"At t = {frame} on {variant} data {_first(able, order, ratios, place)}. Gaps resolved: "
        f"{parts}. Worst ratio of error to that of the target-trained model, of the resolved gaps, "
        "else of all (the worst of several is above 1 even without a shift): "
        f"{told}"
    )
    return Answer(
        ROBUST,
        f"Which model is most robust ({variant})?",
        text,
        variant,
        {model: ratio.result for model, ratio in ratios.items()},
    )


def _first(able: Sequence[str], order: Sequence[str], ratios: dict[str, _Ratio], place: int) -> str:
    """Name the first of those in which a shift can be seen, and how sure that is."""
    if not able:
        return _UNTOLD
    best, others = ratios[able[0]], able[1:]
    near = [model for model in others if ratios[model].low[place] <= best.high[place]]
    sure = f"its interval overlaps those of {', '.join(near)}" if near else "apart from all others"
    text = f"{able[0]} has the smallest worst-engine gap" + (f" ({sure})" if others else "")
    unseen = [model for model in order if model not in able]
    return f"{text}; {', '.join(unseen)} cannot be judged: {_BLIND}" if unseen else text


def _gaps_within(
    field: _Field, trainings: Mapping[str, Training], gaps: Sequence[Gap]
) -> list[Gap]:
    """Gaps of some of a field's trainings to domains of its variant."""
    names = {training.name for training in trainings.values()}
    own = [gap for gap in gaps if gap.model == field.model and gap.training in names]
    return [gap for gap in own if gap.test in field.singles]


def _count_resolved(gaps: Sequence[Gap], place: int) -> str:
    return f"{sum(gap.resolved[place] for gap in gaps)} of {len(gaps)}"


def _worst_gap(field: _Field, gaps: Sequence[Gap], look: Look) -> Array:
    """Largest ratio to the target-trained model."""
    singles = {training.name: training for training in field.singles.values()}
    ratios = [
        _over(look(singles[gap.training], gap.test), look(field.singles[gap.test], gap.test))
        for gap in gaps
    ]
    return np.asarray(np.max(ratios, axis=0))


def _mean_gap(field: _Field, look: Look) -> Array:
    """Geometric mean of the same."""
    pairs = itertools.permutations(field.singles, 2)
    singles = field.singles
    ratios = [_over(look(singles[i], j), look(singles[j], j)) for i, j in pairs]
    return _geometric(ratios)


def _several_engines(
    draws: Draws, field: _Field, gaps: Sequence[Gap], place: int
) -> Iterator[Answer]:
    frame = draws.board.frames[place]
    words = ("helps", "harms", "makes no difference that can be told")
    shared = [name for name in field.without if name in field.singles]
    if shared:
        ratio = _ratio(draws, functools.partial(_left_out_ratio, field, shared))
        parts = _count_resolved(_gaps_within(field, field.without, gaps), place)
        text = (
            f"At t = {frame} leaving one engine out {ratio.verdict(place, *words)} on the engine "
            "left out, against training on a single other engine: error ratio "
            f"{ratio.told(place)}. Of the gaps of these trainings to the target-trained model "
            f"{parts} are resolved"
        )
        question = f"Does training on several others help {field.model} ({field.variant})?"
        yield Answer(LEAVE_ONE_OUT, question, text, field.variant, {field.model: ratio.result})
    if field.everything is not None:
        ratio = _ratio(draws, functools.partial(_worst_of_all_ratio, field))
        text = (
            f"At t = {frame} training on all engines {ratio.verdict(place, *words)} on the worst "
            "engine, against single-engine trainings on their worst: error ratio "
            f"{ratio.told(place)}"
        )
        question = f"Does training on all engines help {field.model} ({field.variant})?"
        yield Answer(ALL, question, text, field.variant, {field.model: ratio.result})


def _left_out_ratio(field: _Field, targets: Sequence[str], look: Look) -> Array:
    """Error without the target over that of single other engines, as geometric means."""
    ratios = []
    for test in targets:
        others = [look(t, test) for name, t in field.singles.items() if name != test]
        ratios.append(_over(look(field.without[test], test), _geometric(others)))
    return _geometric(ratios)


def _worst_of_all_ratio(field: _Field, look: Look) -> Array:
    """Worst engine of the all-engine training over the mean worst of the single ones."""
    assert field.everything is not None
    tests = list(field.singles)
    worst = np.max([look(field.everything, test) for test in tests], axis=0)
    each = [np.max([look(t, test) for test in tests], axis=0) for t in field.singles.values()]
    return _over(worst, _geometric(each))


def _matched(
    draws: Draws, fields: Sequence[_Field], gaps: Sequence[Gap], place: int
) -> Iterator[Answer]:
    """Compare the mean gaps of a model between variants."""
    frame = draws.board.frames[place]
    by_model: dict[str, dict[str, _Field]] = {}
    for field in fields:
        by_model.setdefault(field.model, {})[field.variant] = field
    for model, variants in by_model.items():
        if {"native", "matched"} <= set(variants):
            native, matched = (
                _ratio(draws, functools.partial(_mean_gap, variants[variant]))
                for variant in ("native", "matched")
            )
            change = _ratio(draws, functools.partial(_lessening, variants))
            seen = {
                name: _gaps_within(field, field.singles, gaps) for name, field in variants.items()
            }
            text = f"At t = {frame} {_removal(native, matched, change, seen, place)}. "
            text += f"Mean gap ratio {native.told(place)} on native, {matched.told(place)} on "
            text += f"matched data, {change.told(place)} of the two"
            question = f"Does matched data remove the shift of {model}?"
            yield Answer(MATCHED, question, text, ratios={model: change.result})


def _lessening(variants: dict[str, _Field], look: Look) -> Array:
    """Mean gap on native data over that on matched data, of the same trajectories."""
    return _over(_mean_gap(variants["native"], look), _mean_gap(variants["matched"], look))


def _removal(
    native: _Ratio, matched: _Ratio, change: _Ratio, gaps: dict[str, list[Gap]], place: int
) -> str:
    """Tell a shift that went from one that an interval of matched data is too wide to show."""
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


def _ratio(draws: Draws, figure: Callable[[Look], Array]) -> _Ratio:
    with np.errstate(divide="ignore", invalid="ignore"):
        return _Ratio(figure(draws.mean), *bounds_of(figure(draws.drawn)))


def _over(here: Array, there: Array) -> Array:
    """1 where both are 0: two perfect models do not differ."""
    return np.asarray(np.where((here == 0.0) & (there == 0.0), 1.0, here / there))


def _geometric(figures: Sequence[Array]) -> Array:
    return np.asarray(np.exp(np.mean(np.log(figures), axis=0)))
