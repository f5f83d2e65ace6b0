"""Answers of a shift study: sentences that must follow from made-up errors."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.particles import RolloutFigures
from mbds_xsim.learn.shift.answers import answers_by_interval, answers_of
from mbds_xsim.learn.shift.evaluation import Evaluation
from mbds_xsim.learn.shift.gaps import LONELY, UNKNOWN, Draws
from mbds_xsim.learn.shift.interaction import interactions_of
from mbds_xsim.learn.trained import TrainedModel
from tests.learn import evaluations as made


def _answer(evaluation: Evaluation) -> str:
    draws = Draws(evaluation)
    gaps = made.measured_gaps(evaluation)
    answers = {answer.question: answer.answer for answer in answers_of(draws, gaps, made.FRAMES)}
    return answers["Which model is most robust (native)?"]


def test_a_model_whose_own_domain_is_not_tested_resolves_nothing() -> None:
    evaluation = made.evaluation(made.shifted, floor=100.0)
    fewer = [domain for domain in evaluation.test.domains if domain.engine != "a"]
    test = dataclasses.replace(evaluation.test, domains=tuple(fewer))
    figures = {key: value for key, value in evaluation.figures.items() if key[1] != "a-native"}
    apart = {key: value for key, value in evaluation.oracles.items() if "a-native" not in key}
    evaluation = Evaluation(test, evaluation.frames, figures, apart)
    gaps = made.measured_gaps(evaluation)
    assert {gap.training for gap in gaps if not all(gap.resolved)} == {"a-native"}
    assert {why for gap in gaps if gap.training == "a-native" for why in gap.why} == {UNKNOWN}
    answer = next(answers_of(Draws(evaluation), gaps, made.FRAMES)).answer
    assert "2 of 4 shifts from one engine's data to another's are resolved. In 2 of them" in answer
    assert "2 because the model's own domain is not tested. By chance alone 0.1 of 2 " in answer
    near = {pair: made.figures_of(np.zeros((made.COUNT, made.FRAMES))) for pair in apart}
    assert "this cannot be told" in _answer(dataclasses.replace(evaluation, oracles=near))


def _first_only(evaluation: Evaluation) -> Evaluation:
    """Keep the first seed and the first trajectory."""

    def row(figures: RolloutFigures) -> RolloutFigures:
        return RolloutFigures(*(values[:1] for values in vars(figures).values()))

    return Evaluation(
        dataclasses.replace(evaluation.test, index=evaluation.test.index[:1]),
        evaluation.frames,
        {key: row(figures) for key, figures in evaluation.figures.items() if key[0].seed == 0},
        {key: row(figures) for key, figures in evaluation.oracles.items()},
    )


def test_one_trajectory_tells_nothing_from_chance() -> None:
    evaluation = _first_only(made.evaluation(made.shifted, floor=100.0))
    gaps, interactions = made.measured_gaps(evaluation), interactions_of(Draws(evaluation))
    assert {why for gap in gaps for why in gap.why} == {LONELY}
    assert {gap.ratio_low for gap in gaps} == {each.low for each in interactions} == {(None, None)}
    assert not any(any(each.resolved) for each in interactions)
    answer = next(answers_of(Draws(evaluation), gaps, made.FRAMES)).answer
    assert "0 of 6 shifts from one engine's data to another's are resolved" in answer
    assert "6 because one trajectory gives no interval" in answer
    assert "gns 4 [no interval]" in _answer(evaluation)
    assert "this cannot be told" in _answer(evaluation)


def test_no_model_is_called_robust_where_no_shift_is_resolved() -> None:
    answer = _answer(made.evaluation(made.shifted, floor=1e-3))
    assert "this cannot be told" in answer
    assert "Gaps resolved: 0 of 6 of gns" in answer
    answer = _answer(made.evaluation(made.shifted, floor=100.0))
    assert "gns has the smallest worst-engine gap" in answer
    assert "Gaps resolved: 6 of 6 of gns" in answer
    assert "gns 4 [" in answer


def test_a_model_that_is_worse_than_the_engines_differ_is_not_called_robust() -> None:
    good, bad = (
        made.evaluation(made.shifted, floor=100.0),
        made.evaluation(lambda *_: np.full((made.COUNT, made.FRAMES), 1e3), 1.0),
    )
    weak = {
        (dataclasses.replace(entry, model="sgnn"), name): value
        for (entry, name), value in bad.figures.items()
    }
    answer = _answer(Evaluation(good.test, good.frames, {**good.figures, **weak}, good.oracles))
    assert "gns has the smallest worst-engine gap; sgnn cannot be judged" in answer
    assert "sgnn 1 [1, 1]" in answer
    assert "Gaps resolved: 6 of 6 of gns, 0 of 6 of sgnn" in answer


def test_resolved_gains_are_not_told_as_losses() -> None:
    def error(training: str, engine: str, seed: int) -> Array:
        figures = made.shifted(training, engine, seed)
        return figures / 16.0 if (training, engine) == ("a", "b") else figures

    evaluation = made.evaluation(error, floor=100.0)
    gaps = made.measured_gaps(evaluation)
    answer = next(answers_of(Draws(evaluation), gaps, made.FRAMES)).answer
    assert "6 of 6 shifts" in answer
    assert "In 5 of them the model errs more than the one trained there, in 1 less" in answer


def test_a_model_that_errs_as_much_at_home_is_not_harmed_by_the_change() -> None:
    """The gap to the target's model comes from the data that each model was given."""

    def error(training: str, engine: str, seed: int) -> Array:
        if training == "c":
            return np.full((made.COUNT, made.FRAMES), 9.0 if engine == "c" else 8.0)
        return made.shifted(training, engine, seed) / 4.0

    results = made.evaluation(error, floor=100.0)
    answer = next(answers_of(Draws(results), made.measured_gaps(results), made.FRAMES)).answer
    assert "than the one trained there (in 2 of these no more than at home: its data" in answer
    results = made.evaluation(made.shifted, floor=100.0)
    assert (
        "at home"
        not in next(answers_of(Draws(results), made.measured_gaps(results), made.FRAMES)).answer
    )


def test_only_resolved_gaps_tell_which_model_is_most_robust() -> None:
    """A pair whose engines differ by less than the model's error has the worst ratio of all."""

    def error(training: str, engine: str, seed: int) -> Array:
        figures = made.shifted(training, engine, seed)
        return 10.0 * figures if (training, engine) == ("a", "b") else figures

    evaluation = made.evaluation(error, floor=100.0)
    near = {("a-native", "b-native"): made.figures_of(np.zeros((made.COUNT, made.FRAMES)))}
    answer = _answer(dataclasses.replace(evaluation, oracles={**evaluation.oracles, **near}))
    assert "Gaps resolved: 5 of 6 of gns" in answer
    assert "gns 4 [" in answer


def test_of_several_engines_the_one_that_bounds_the_error_best_is_told() -> None:
    """√R_ij ≤ √R_ii + √D_ij holds for each of them; the least bound decides."""
    errors = {"a": 0.09, "b": 0.01, "c": 0.04}
    evaluation = made.evaluation(
        lambda _, engine, __: np.full((made.COUNT, made.FRAMES), errors[engine]), floor=1.0
    )
    entry = made.entry_of("not-c", 0, ("a", "b"))
    figures = {
        (entry, f"{engine}-native"): made.figures_of(np.full((made.COUNT, made.FRAMES), error))
        for engine, error in errors.items()
    }
    near = {("a-native", "c-native"): made.figures_of(np.full((made.COUNT, made.FRAMES), 0.16))}
    evaluation = Evaluation(
        evaluation.test,
        evaluation.frames,
        {**evaluation.figures, **figures},
        {**evaluation.oracles, **near},
    )
    gap = next(gap for gap in made.measured_gaps(evaluation) if gap.kind == "leave-one-out")
    assert (gap.own[0], gap.engine_floor[0]) == (0.09, 0.16)  # 0.3 + 0.4, not 0.1 + 1
    assert gap.why[0] == "interval contains 0"


def test_seeds_of_one_number_are_drawn_together() -> None:
    """An effect of a seed on all trainings alike cancels in their ratio."""

    def error(training: str, engine: str, seed: int) -> Array:
        return 0.01 * made.shifted(training, engine, 0) * (1.0 + seed)

    for gap in made.measured_gaps(made.evaluation(error, floor=1e3)):
        assert gap.ratio_low[0] == pytest.approx(4.0)
        assert gap.ratio_high[0] == pytest.approx(4.0)


def test_two_engines_less_one_are_told_once() -> None:
    evaluation = made.evaluation(made.shifted, floor=100.0)
    tested = ("a-native", "b-native")
    figures = {key: value for key, value in evaluation.figures.items() if key[0].training in tested}
    for (entry, name), value in list(figures.items()):
        other = {"a": "not-b", "b": "not-a"}[entry.engines[0]]
        figures[made.entry_of(other, entry.seed, entry.engines), name] = value
    domains = tuple(domain for domain in evaluation.test.domains if domain.name in tested)
    test = dataclasses.replace(evaluation.test, domains=domains)
    gaps = made.measured_gaps(Evaluation(test, evaluation.frames, figures, evaluation.oracles))
    assert [(gap.training, gap.test) for gap in gaps] == [
        ("a-native", "b-native"),
        ("b-native", "a-native"),
    ]


def test_all_engines_means_all_where_some_engine_is_not_tested() -> None:
    evaluation = made.evaluation(made.shifted, floor=100.0)
    tested = ("a-native", "b-native")
    domains = tuple(domain for domain in evaluation.test.domains if domain.name in tested)
    figures = {key: value for key, value in evaluation.figures.items() if key[1] in tested}
    for name, engines, error in (("not-c", ("a", "b"), 50.0), ("all", ("a", "b", "c"), 1e-3)):
        entry = made.entry_of(name, 0, engines)
        figures |= {
            (entry, test): made.figures_of(np.full((made.COUNT, made.FRAMES), error))
            for test in tested
        }
    test = dataclasses.replace(evaluation.test, domains=domains)
    evaluation = Evaluation(test, evaluation.frames, figures, evaluation.oracles)
    answers = _answers(evaluation)
    assert "helps" in answers["Does training on all engines help gns (native)?"]


def _of_variants(
    away: dict[str, float], spread: float, more: Mapping[str, float] = MappingProxyType({})
) -> Evaluation:
    """Two engines, natively and matched; errors away from home are so many times those at home.

    `more` has such factors of domains of other engines.
    """
    test = made.paired(("a", "b"))
    parts = [dataclasses.replace(d, variant=v) for v in away for d in test.domains]
    for name in more:
        engine, _, variant = name.rpartition("-")
        parts.append(dataclasses.replace(parts[0], engine=engine, variant=variant))
    test = dataclasses.replace(test, domains=tuple(parts))
    figures, rng = {}, np.random.default_rng(5)
    for home, seed in itertools.product(parts, range(3)):
        entry = TrainedModel(
            "gns", home.name, (home.engine,), home.variant, seed, Path(f"{home.name}{seed}"), "", ""
        )
        for domain in parts:
            luck = np.exp(
                spread * rng.standard_normal((made.COUNT, 1)) * (home.variant == "matched")
            )
            factor = more.get(domain.name, more.get(home.name, away[home.variant]))
            error = luck * (1.0 if domain is home else factor)
            figures[entry, domain.name] = made.figures_of(np.tile(error, (1, made.FRAMES)))
    pairs = itertools.permutations([domain.name for domain in parts], 2)
    apart = {pair: made.figures_of(np.full((made.COUNT, made.FRAMES), 100.0)) for pair in pairs}
    return Evaluation(test, (1, made.FRAMES), figures, apart)


@pytest.mark.parametrize(
    ("native", "matched", "spread", "says"),
    [
        (1.0, 1.0, 0.0, "native data show no shift that"),
        (4.0, 1.0, 0.0, "no shift is left on matched data. Mean"),
        (4.0, 2.0, 0.0, "matched data lessen the shift"),
        (4.0, 4.0, 0.0, "the shift is there on matched data too"),
        (1.2, 1.0, 2.0, "whether matched data remove the shift cannot be told"),
    ],
)
def test_whether_matched_data_remove_a_shift(
    native: float, matched: float, spread: float, says: str
) -> None:
    evaluation = _of_variants({"native": native, "matched": matched}, spread)
    answers = _answers(evaluation)
    assert says in answers["Does matched data remove the shift of gns?"]


@pytest.mark.parametrize("more", ["native", "matched"])
def test_native_and_matched_data_are_compared_over_the_engines_of_both(more: str) -> None:
    """A third engine has data of one variant alone, where its changes cost a hundred times."""
    evaluation = _of_variants({"native": 4.0, "matched": 2.0}, 0.0, {f"c-{more}": 100.0})
    answer = _answers(evaluation)["Does matched data remove the shift of gns?"]
    assert answer.startswith("At t = 5 between a, b matched data lessen the shift. ")
    assert "native 4 [4, 4], matched 2 [2, 2], native over matched 2 [2, 2]" in answer
    (lone,) = {d for d in evaluation.test.domains if d.name == f"b-{more}"}
    fewer = tuple(d for d in evaluation.test.domains if d is not lone)
    evaluation = dataclasses.replace(
        evaluation, test=dataclasses.replace(evaluation.test, domains=fewer)
    )
    assert "Does matched data remove the shift of gns?" not in _answers(evaluation)


def test_changes_of_engine_are_counted_apart_from_those_of_settings() -> None:
    """Of 12 pairs of four domains 4 are of two engines at the same settings."""
    evaluation = _of_variants({"native": 4.0, "matched": 1.0}, 0.0)
    answer = next(answers_of(Draws(evaluation), made.measured_gaps(evaluation), made.FRAMES)).answer
    apart = "of 12 shifts from one engine's data to another's are resolved (2 of 4 at the same "
    assert f"{apart}settings, " in answer
    assert " of 8 from other settings)" in answer


def _answers(evaluation: Evaluation) -> dict[str, str]:
    return {
        a.question: a.answer
        for a in answers_of(Draws(evaluation), made.measured_gaps(evaluation), made.FRAMES)
    }


def _of_matched_data(evaluation: Evaluation, oracles: dict[tuple[str, str], RolloutFigures]) -> str:
    answers = _answers(dataclasses.replace(evaluation, oracles=oracles))
    return answers["Does matched data remove the shift of gns?"]


def test_matched_data_remove_no_shift_of_a_model_that_shows_none() -> None:
    results = _of_variants({"native": 4.0, "matched": 1.0}, 0.0)
    same = {pair: made.figures_of(np.zeros((made.COUNT, made.FRAMES))) for pair in results.oracles}
    answer = _of_matched_data(results, same)
    assert "this cannot be told: where no gap is resolved" in answer
    assert "Mean gap ratio: native 4 [4, 4]" in answer


def test_what_is_not_resolved_on_matched_data_is_no_shift() -> None:
    """Errors may clearly differ there: engines differ by less than the errors."""
    evaluation = _of_variants({"native": 4.0, "matched": 2.0}, 0.0)
    oracles = {
        pair: made.figures_of(np.zeros((made.COUNT, made.FRAMES)))
        if all("matched" in n for n in pair)
        else apart
        for pair, apart in evaluation.oracles.items()
    }
    answer = _of_matched_data(evaluation, oracles)
    assert "no shift is resolved on matched data, whose engines differ by less than" in answer
    assert "matched 2 [2, 2]" in answer


def test_what_a_change_of_speed_costs() -> None:
    """Trained on another interval, models have 9 times the error, in medium starts 25 times."""
    evaluation = made.evaluation(made.shifted, floor=1.0)
    figures = dict(evaluation.figures)
    place = np.arange(made.COUNT) % 3
    hard = np.exp(np.random.default_rng(2).standard_normal(made.COUNT))
    for own, interval in enumerate(("low", "medium", "high")):
        away = np.where(place == own, 1.0, np.where(place == 1, 25.0, 9.0))
        entry = dataclasses.replace(made.entry_of(f"a-{interval}", 0, ("a",)), interval=interval)
        error = np.tile((0.01 * hard * away)[:, None], (1, made.FRAMES))
        for engine in ("a", "b", "c"):
            figures[entry, f"{engine}-native"] = made.figures_of(error)
    whole = Evaluation(evaluation.test, evaluation.frames, figures, evaluation.oracles)
    (answer,) = answers_by_interval(whole, made.FRAMES)
    assert answer.question == "What does a change of speed cost (a-native)?"
    ratio = answer.ratios["gns"]
    for bound in (ratio.low, ratio.value, ratio.high):
        assert bound == pytest.approx((25.0, 25.0))
    assert made.measured_gaps(whole) == made.measured_gaps(evaluation)
    assert list(answers_by_interval(evaluation, made.FRAMES)) == []
