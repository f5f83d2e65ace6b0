"""Whether a change of engine costs a model anything, apart from luck and from how hard data are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.shift.gaps import Draws
from mbds_xsim.learn.shift.interaction import (
    answers_of_interactions,
    chance_beyond,
    interactions_of,
)
from mbds_xsim.learn.shift.result import Interaction

from .evaluations import COUNT, FRAMES, evaluation

_LUCK = {"a": 1e-3, "b": 7e-3, "c": 2e-4}
_HARD = {"a": 0.5, "b": 3.0, "c": 11.0}


def _found(error: Callable[[str, str, int], Array]) -> tuple[Interaction, ...]:
    return interactions_of(Draws(evaluation(error, floor=0.0)))


def _product(training: str, engine: str, away: float, spread: float, seed: int = 0) -> Array:
    """Return errors: luck of the training × hardness of the engine's data × loss away from home."""
    rng = np.random.default_rng([ord(training), ord(engine), seed])
    noise = np.exp(spread * rng.standard_normal((COUNT, 1)))
    loss = 1.0 if training == engine else away
    return np.tile(_LUCK[training] * _HARD[engine] * loss * noise, (1, FRAMES))


def test_luck_of_trainings_and_hard_engines_are_no_loss() -> None:
    interactions = _found(lambda i, j, _: _product(i, j, 1.0, 0.0))
    assert [(each.first, each.second) for each in interactions] == [
        ("a-native", "b-native"),
        ("a-native", "c-native"),
        ("b-native", "c-native"),
    ]
    for each in interactions:
        assert each.value == pytest.approx((1.0, 1.0))
        assert each.low == pytest.approx((1.0, 1.0))
        assert each.seeds == 3


@pytest.mark.parametrize("away", [4.0, 0.25])
def test_what_is_lost_away_from_home_is_told_whatever_else_is_so(away: float) -> None:
    """The loss is measured both ways, which leaves the geometric mean of the two losses."""
    interactions = _found(lambda i, j, seed: _product(i, j, away, 0.3, seed))
    for each in interactions:
        assert each.value[0] == pytest.approx(away, rel=0.5)
        low, high = each.low[0], each.high[0]
        assert low is not None
        assert high is not None
        assert low < away < high
        assert each.resolved == (True, True)


@pytest.mark.parametrize("alike", [False, True])
def test_of_many_pairs_without_a_loss_hardly_one_is_told(alike: bool) -> None:
    """By chance one 95 % interval in twenty would not contain 1; the rule corrects for that.

    If a run errs alike on all trajectories, there are but three to tell the spread from.
    """
    losses = [
        any(resolved for each in _found(_chance(number, alike)) for resolved in each.resolved)
        for number in range(20)
    ]
    assert sum(losses) <= 2  # of twenty studies of three pairs


def _chance(number: int, alike: bool) -> Callable[[str, str, int], Array]:
    def error(training: str, engine: str, seed: int) -> Array:
        errors = _product(training, engine, 1.0, 0.5, 100 * number + seed)
        return np.broadcast_to(errors[:1], errors.shape) if alike else errors

    return error


@pytest.mark.parametrize("seeds", [2, 3, 5])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_no_more_is_told_by_chance_than_should_be(seeds: int, share: float) -> None:
    """By Satterthwaite's degrees of freedom it would be up to 12 % of 5 %, and 8 % of 1 %."""
    rng, count = np.random.default_rng(0), 40_000
    known = [
        part * rng.chisquare(number - 1, count) / (number - 1)
        for part, number in ((share, seeds), (1.0 - share, 30))
    ]
    size = np.abs(rng.standard_normal(count)) / np.sqrt(sum(known))
    chance = chance_beyond(size, known[0] / sum(known), seeds, 30)
    assert np.mean(chance < 0.05) < 0.055
    assert np.mean(chance < 0.01) < 0.0125


def test_perfect_models_have_no_interaction() -> None:
    pairs = _found(lambda *_: np.zeros((COUNT, FRAMES)))
    assert all(each.value == (None, None) and each.resolved == (False, False) for each in pairs)
    (answer,) = answers_of_interactions(pairs, 0, 1)
    assert answer.answer == "At t = 1 on native data gns has errors of 0"


def test_the_answer_names_the_pair_that_loses_most() -> None:
    def error(training: str, engine: str, seed: int) -> Array:
        return _product(
            training, engine, 9.0 if {training, engine} == {"a", "c"} else 1.0, 0.1, seed
        )

    (answer,) = answers_of_interactions(_found(error), 0, 1)
    assert answer.question == "What does a change of engine cost on native data?"
    assert "gns loses in 1 of 3 pairs, at most " in answer.answer
    assert answer.answer.endswith("squared error, between a-native and c-native")

    (answer,) = answers_of_interactions(_found(lambda i, j, _: _product(i, j, 1.0, 0.0)), 1, FRAMES)
    assert "loses nothing that can be told, 1 times the squared error on average" in answer.answer


def test_settings_of_one_engine_are_compared_too_but_not_both_at_once() -> None:
    """Native against undamped is one change; against another engine's undamped data it is two."""
    study = evaluation(lambda i, j, seed: _product(i, j, 4.0, 0.1, seed), floor=0.0)
    names = {"a-native": "a-native", "b-native": "a-undamped", "c-native": "c-undamped"}
    domains = tuple(
        dataclasses.replace(d, engine=names[d.name][0], variant=names[d.name][2:])
        for d in study.test.domains
    )
    figures = {
        (
            dataclasses.replace(
                run,
                training=names[run.training],
                engines=(names[run.training][0],),
                variant=names[run.training][2:],
            ),
            names[test],
        ): each
        for (run, test), each in study.figures.items()
    }
    study = dataclasses.replace(
        study, test=dataclasses.replace(study.test, domains=domains), figures=figures, oracles={}
    )

    interactions = interactions_of(Draws(study))

    assert [(each.first, each.second) for each in interactions] == [
        ("a-native", "a-undamped"),
        ("a-undamped", "c-undamped"),
    ]
    assert [answer.question for answer in answers_of_interactions(interactions, 0, 1)] == [
        "What does a change of engine cost on undamped data?",
        "What does a change of settings cost in a?",
    ]
