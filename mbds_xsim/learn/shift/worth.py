"""How good must data be? The cost of their errors to the models that learn from them.

A model is compared with itself: its error on the truth after training on one domain, over its error
after training on the reference's data. A ratio of 1 is no harm, 2 is twice the squared error. Both
are tested on the same trajectories, and runs of a seed share their first weights and windows, so
the rest is due to the data.

Data harm a model if the ratio differs from 1 significantly and is at least 1.1: less can come from
another run of the same training. That no harm is found proves nothing by itself: data are called
harmless only if the interval, too, is below the bearable ratio.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.text import counted
from mbds_xsim.learn.shift.domains import REFERENCE
from mbds_xsim.learn.shift.evaluation import ENGINE, Evaluation
from mbds_xsim.learn.shift.gaps import Draws, Look, trainings_of
from mbds_xsim.learn.shift.interaction import BEARABLE, compared
from mbds_xsim.learn.shift.result import INTERVALS, Answer, DomainFacts, Harm, Shift
from mbds_xsim.learn.trained import TrainedModel

WORTH = "worth"
"""Kind of answer."""
HARMFUL, UNTOLD, HARMLESS = "harmful", "cannot be told", "harmless"
"""Verdicts on data for a model, the worst first."""
NOTABLE = 1.1
"""Least harmful ratio of squared errors: less can come from another run, even if significant."""


def harms_of(draws: Draws) -> tuple[Harm, ...]:
    """Compare every training on one domain with that on the reference's data, if there are any."""
    evaluation = draws.evaluation
    pairs = [pair for model in evaluation.models for pair in _pairs(evaluation, model)]
    return compared(draws, pairs, _ratio, Harm)


def _ratio(training: TrainedModel, best: TrainedModel, look: Look) -> Array:
    return look(training, REFERENCE) / look(best, REFERENCE)


def _pairs(evaluation: Evaluation, model: str) -> Iterator[tuple[TrainedModel, TrainedModel]]:
    """Yield each training on one domain with the one that learned from the best data."""
    oracles = evaluation.oracles
    singles = [
        training
        for training in trainings_of(evaluation, model)
        if training.single and (training.domains[0], REFERENCE) in oracles
    ]
    references = [training for training in singles if training.engines == (REFERENCE,)]
    if references:
        best = min(references, key=lambda t: np.nanmean(oracles[t.domains[0], REFERENCE].error))
        yield from ((training, best) for training in singles if training is not best)


def verdict(harm: Harm, place: int) -> str:
    """Return the verdict on the data for the model at a frame."""
    value, high = harm.value[place], harm.high[place]
    if harm.resolved[place] and value is not None and value >= NOTABLE:
        return HARMFUL
    return HARMLESS if high is not None and high < BEARABLE else UNTOLD


def verdicts(harms: Sequence[Harm], place: int) -> dict[str, str]:
    """Return the verdict on all data at a frame, for the model that they are worst for.

    It cannot be told of data that a model was not trained on.
    """
    known = {(harm.model, harm.second): HARMLESS for harm in harms}
    known |= {(harm.model, harm.first): verdict(harm, place) for harm in harms}
    models = {model for model, _ in known}
    return {
        name: min(
            (known.get((model, name), UNTOLD) for model in models),
            key=(HARMFUL, UNTOLD, HARMLESS).index,
        )
        for name in dict.fromkeys(name for _, name in known)
    }


def distances(shift: Shift, place: int) -> dict[str, float]:
    """Return the mean squared distance of all data from the truth at a frame [m²], by domain."""
    return {
        floor.first: distance
        for floor in shift.floors
        if (floor.kind, floor.test, floor.interval) == (ENGINE, REFERENCE, INTERVALS[0])
        and (distance := floor.mse[place]) is not None
    }


def noise_of(shift: Shift, place: int) -> float | None:
    """Return the mean squared distance due to the random forces, which no model knows [m²]."""
    return next((floor.mse[place] for floor in shift.floors if floor.kind == "noise"), None)


def answer_of_harms(shift: Shift) -> Iterator[Answer]:
    """Name the cheapest data that harm no model, and say how far from the truth data may be.

    With contact a second answer does so for frames after the first contact.
    """
    place = shift.frames.index(shift.at)
    if text := _cheapest(shift, shift.harms, place, f"At t = {shift.at}"):
        noise, words = noise_of(shift, place), verdicts(shift.harms, place)
        text += f". {_reach(words, distances(shift, place))}"
        text += f", the random forces, which no model is told, {noise:.2g} m²" if noise else ""
        text += _unsure(words)
        yield Answer(WORTH, "How good must data be?", text)
    if shift.harms_after_contact:
        yield from _answer_after_contact(shift)


def _answer_after_contact(shift: Shift) -> Iterator[Answer]:
    place, harms = shift.contact_place(shift.at), shift.harms_after_contact
    when = f"At t = {shift.contact_frames[place]} after the first contact"
    if text := _cheapest(shift, harms, place, when):
        words = verdicts(harms, place)
        harmful = ", ".join(name for name, word in words.items() if word == HARMFUL)
        text += f". Harmful: {harmful or 'none'}{_unsure(words)}"
        yield Answer(WORTH, "How good must data be after the first contact?", text)


def _unsure(words: Mapping[str, str]) -> str:
    """State of how many data it cannot be told whether they harm, if there are any."""
    count = sum(word == UNTOLD for word in words.values())
    return f"; of {counted(count, 'other')} it {UNTOLD}" if count else ""


def _cheapest(shift: Shift, harms: Sequence[Harm], place: int, when: str) -> str:
    """Name the cheapest data of each engine that harm no model; "" if no harm is known."""
    if all(harm.value[place] is None for harm in harms):
        return ""
    worst, cheapest = verdicts(harms, place), dict[str, DomainFacts]()
    by_cost = sorted((d for d in shift.domains if d.name in worst and d.cost_s), key=_milliseconds)
    for domain in by_cost:
        if worst[domain.name] == HARMLESS:
            cheapest.setdefault(domain.engine, domain)
    models = ", ".join(dict.fromkeys(harm.model for harm in harms))
    if not cheapest:
        return f"{when} no data of known cost are known to be harmless to all of {models}"
    first, *others = (f"{d.name}, {_milliseconds(d):.3g} ms" for d in cheapest.values())
    none = [f"none of {e}" for e in dict.fromkeys(d.engine for d in by_cost) if e not in cheapest]
    return (
        f"{when} the cheapest data that harm none of {models} are {first} of processor "
        f"time for a trajectory{''.join(f'; {engine}' for engine in (*others, *none))}"
    )


def _milliseconds(domain: DomainFacts) -> float:
    return 1e3 * (domain.cost_s or 0.0)


def _reach(worst: Mapping[str, str], apart: Mapping[str, float]) -> str:
    """Say how far from the truth harmful and harmless data are."""
    harmful, harmless = (
        [apart[name] for name, word in worst.items() if word == kind and name in apart]
        for kind in (HARMFUL, HARMLESS)
    )
    begin = "No data are known to harm"
    if harmful:
        begin = f"Data that harm are at least {min(harmful):.2g} m²"
    elif HARMFUL in worst.values():
        begin = "How far from the truth data that harm are is not known"
    end = f", the harmless are at most {max(harmless):.2g} m² from the truth" if harmless else ""
    return begin + end
