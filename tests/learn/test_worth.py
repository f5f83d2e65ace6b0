"""Harm by training data is found where it was planted, and nowhere else."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from io import StringIO
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from mbds_xsim.learn.shift import study
from mbds_xsim.learn.shift.domains import REFERENCE, Recorded
from mbds_xsim.learn.shift.evaluation import Evaluation
from mbds_xsim.learn.shift.result import DomainFacts, Shift
from mbds_xsim.learn.shift.rollouts import RolloutPlan
from mbds_xsim.learn.shift.worth import (
    HARMFUL,
    HARMLESS,
    UNTOLD,
    answer_of_harms,
    verdict,
    verdicts,
)
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.report.files import to_html, to_markdown
from mbds_xsim.report.terminal import print_report
from mbds_xsim.studies.shift.present import present, to_png
from mbds_xsim.studies.shift.worth import worth_table
from tests.learn.evaluations import COUNT, FRAMES, figures_of, paired

_COSTS = {
    "reference-fine": 5e-3,
    "reference-loose": 1e-3,
    "a-fine": 4e-3,
    "a-coarse": 2e-3,
    "b-coarse": 3e-3,
}
_APART = {
    "reference-fine": 1e-16,
    "reference-loose": 1e-12,
    "a-fine": 1e-8,
    "a-coarse": 1e-4,
    "b-coarse": 1e-5,
}
_SEEDS = 3


def _model(name: str, seed: int) -> TrainedModel:
    engine, _, variant = name.rpartition("-")
    path = Path(f"{name}{seed}")
    return TrainedModel("gns", name, (engine,), variant, seed, path, str(path))


def _study(
    factors: Mapping[str, float], spread: float = 0.1, names: Iterable[str] = tuple(_COSTS)
) -> Shift:
    """Make up a study of a model whose error on the truth is so many times the least."""
    rng = np.random.default_rng(5)
    hard = np.exp(rng.standard_normal((COUNT, 1)))  # some starts are harder for all models
    domains = tuple(
        Recorded(*_named(name)[1:], Path(name), tuple(range(COUNT)), name) for name in names
    )
    test = dataclasses.replace(paired(("a",)), domains=domains)
    figures = {
        (_model(name, seed), tested): figures_of(
            np.tile(
                factors.get(name, 1.0) * hard * np.exp(spread * rng.standard_normal((COUNT, 1))),
                (1, FRAMES),
            )
        )
        for name in names
        for seed in range(_SEEDS)
        for tested in (*names, REFERENCE)
    }
    oracles = {
        (name, REFERENCE): figures_of(np.full((COUNT, FRAMES), _APART[name])) for name in names
    }
    noise = {"noise": np.full((COUNT, FRAMES), 1e-6)}
    evaluation = Evaluation(test, (1, FRAMES), figures, oracles, floors=noise)
    facts = [DomainFacts(*_named(name), name, _COSTS.get(name)) for name in (*names, REFERENCE)]
    models = tuple(study._facts(evaluation, run) for run in evaluation.entries)
    shift = study._shift(
        evaluation, RolloutPlan(FRAMES), FRAMES,
        command="", domains=tuple(facts), left_out={}, models=models, kept=0,
    )  # fmt: skip
    return msgspec.structs.replace(shift, answers=tuple(answer_of_harms(shift)))


def _named(name: str) -> tuple[str, str, str]:
    engine, _, variant = name.rpartition("-")
    return (name, engine, variant) if engine else (name, name, "")


def test_harm_is_found_where_it_was_planted() -> None:
    shift = _study({"a-coarse": 4.0, "b-coarse": 1.6})
    harms = {harm.first: harm for harm in shift.harms}
    assert set(harms) == set(_COSTS) - {"reference-fine"}
    assert {harm.second for harm in shift.harms} == {"reference-fine"}
    assert {harm.seeds for harm in shift.harms} == {_SEEDS}
    assert harms["a-coarse"].value[0] == pytest.approx(4.0, rel=0.2)
    low, high = harms["a-coarse"].low[0], harms["a-coarse"].high[0]
    assert low is not None
    assert high is not None
    assert 3.0 < low < 4.0 < high < 5.0
    assert verdicts(shift.harms, 0) == {
        "reference-fine": HARMLESS,
        "reference-loose": HARMLESS,
        "a-fine": HARMLESS,
        "a-coarse": HARMFUL,
        "b-coarse": HARMFUL,
    }


def test_where_no_harm_was_planted_none_is_found() -> None:
    assert set(verdicts(_study({}).harms, 0).values()) == {HARMLESS}


def test_as_much_as_another_run_makes_is_no_harm() -> None:
    harms = _study({"a-coarse": 1.05, "b-coarse": 1.2}, spread=1e-3).harms
    assert all(harm.resolved[0] for harm in harms if harm.first.endswith("coarse"))
    judged = verdicts(harms, 0)
    assert (judged["a-coarse"], judged["b-coarse"]) == (HARMLESS, HARMFUL)


def test_a_gain_is_no_harm_and_what_is_not_known_well_cannot_be_told() -> None:
    gained = _study({"b-coarse": 0.25})
    (harm,) = (each for each in gained.harms if each.first == "b-coarse")
    assert harm.resolved == (True, True)
    assert verdict(harm, 0) == HARMLESS
    unsure = _study({}, spread=3.0)
    assert UNTOLD in {verdict(harm, 0) for harm in unsure.harms}


def test_the_answer_names_the_cheapest_data_that_harm_no_model() -> None:
    """The answer names them for each engine, and how far from the truth data may be."""
    (answer,) = _study({"a-coarse": 4.0, "b-coarse": 2.0}).answers
    assert answer.question == "How good must data be?"
    assert answer.answer == (
        "At t = 5 the cheapest data that harm none of gns are reference-loose, 1 ms of processor "
        "time for a trajectory; a-fine, 4 ms; none of b. Data that harm are at least 1e-05 "
        "m², the harmless are at most 1e-08 m² from the truth, the random forces, which no model "
        "is told, 1e-06 m²"
    )
    (answer,) = _study({}).answers
    assert "reference-loose, 1 ms" in answer.answer
    assert "; a-coarse, 2 ms; b-coarse, 3 ms. No data are known to harm, the" in answer.answer


def test_what_is_harmless_before_a_contact_may_harm_after_it() -> None:
    flying, later = _study({"a-coarse": 4.0}), _study({"a-fine": 4.0, "b-coarse": 4.0})
    shift = msgspec.structs.replace(flying, contact_frames=(1, 3), harms_after_contact=later.harms)
    before, after = answer_of_harms(shift)
    assert before in flying.answers
    assert after.question == "How good must data be after the first contact?"
    assert after.answer == (
        "At t = 3 after the first contact the cheapest data that harm none of gns are "
        "reference-loose, 1 ms of processor time for a trajectory; a-coarse, 2 ms; none of b. "
        "Harmful: a-fine, b-coarse"
    )
    cells = {row.texts[0]: row.texts[3] for row in worth_table(shift, 1).rows}
    assert [part.endswith(HARMLESS) for part in cells["a-fine"].split("; after contact ×")] == [
        True,
        False,
    ]
    unknown = tuple(
        msgspec.structs.replace(harm, value=(None, None), low=(None, None), high=(None, None))
        for harm in later.harms
    )
    assert len(list(answer_of_harms(msgspec.structs.replace(shift, harms=unknown)))) == 1


def test_a_study_with_contact_judges_data_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _study({"a-coarse": 4.0}).harms_after_contact == ()
    monkeypatch.setattr(study, "from_contact", lambda evaluation: evaluation)  # at once
    shift = _study({"a-coarse": 4.0})
    assert shift.contact_frames == shift.frames
    assert shift.harms_after_contact == shift.harms
    assert [answer.question for answer in shift.answers] == [
        "How good must data be?", "How good must data be after the first contact?",
    ]  # fmt: skip


def test_without_distances_from_the_truth_none_is_told() -> None:
    shift = msgspec.structs.replace(_study({}), floors=())
    (answer,) = answer_of_harms(shift)
    assert answer.answer.endswith("No data are known to harm")
    (answer,) = answer_of_harms(msgspec.structs.replace(_study({"a-coarse": 4.0}), floors=()))
    assert answer.answer.endswith("How far from the truth data that harm are is not known")


def test_the_answer_states_of_how_many_data_it_cannot_be_told() -> None:
    """That no data are known to harm does not say that none do."""
    shift = _study({})
    wide = tuple(
        msgspec.structs.replace(harm, high=(50.0, 50.0)) if harm.first != "a-fine" else harm
        for harm in shift.harms
    )
    (answer,) = answer_of_harms(msgspec.structs.replace(shift, harms=wide))
    assert "No data are known to harm, the harmless are at most 1e-08 m² from" in answer.answer
    assert answer.answer.endswith("; of 3 others it cannot be told")


def test_data_that_a_model_was_not_trained_on_are_not_harmless_to_it() -> None:
    shift = _study({})
    other = [msgspec.structs.replace(h, model="sgnn") for h in shift.harms if h.first != "a-fine"]
    assert verdicts([*shift.harms, *other], 0) == {
        "reference-fine": HARMLESS,
        "reference-loose": HARMLESS,
        "a-fine": UNTOLD,
        "a-coarse": HARMLESS,
        "b-coarse": HARMLESS,
    }
    both = msgspec.structs.replace(shift, harms=(*shift.harms, *other))
    (answer,) = answer_of_harms(both)
    assert "harm none of gns, sgnn are reference-loose, 1 ms" in answer.answer
    assert "a-fine" not in answer.answer
    worse = [msgspec.structs.replace(h, second="reference-loose") for h in other]
    apart = verdicts([*shift.harms, *(h for h in worse if h.first != "reference-loose")], 0)
    assert apart["reference-loose"] == HARMLESS  # one model's best data, no harm to the other
    assert apart["reference-fine"] == UNTOLD


def test_without_data_of_the_reference_nothing_is_asked() -> None:
    """The best model is not known then; the cost of data is shown all the same."""
    names = tuple(name for name in _COSTS if not name.startswith(REFERENCE))
    shift = _study({"a-coarse": 4.0}, names=names)
    assert (shift.harms, shift.answers) == ((), ())
    assert len(worth_table(shift, 1).rows) == len(names)
    assert "×" not in to_markdown([present(shift)])


def test_harm_is_told_where_the_cost_of_data_is_not_known() -> None:
    """Data that were fetched have no log; the picture is then that of the changes."""
    priced = _study({"a-coarse": 4.0})
    free = tuple(msgspec.structs.replace(domain, cost_s=None) for domain in priced.domains)
    shift = msgspec.structs.replace(priced, domains=free)
    (answer,) = answer_of_harms(shift)
    assert answer.answer.startswith(
        "At t = 5 no data of known cost are known to be harmless to all of gns. Data that harm"
    )
    harms = [
        {row.texts[0]: row.texts[3] for row in worth_table(s, 1).rows} for s in (priced, shift)
    ]
    assert harms[0] == harms[1]
    assert to_png([shift]) != to_png([priced])


def test_table_page_and_picture_show_it() -> None:
    shift = _study({"a-coarse": 4.0})
    table = worth_table(shift, 1)
    assert [row.texts[:3] for row in table.rows] == [
        ("reference-loose", "1.0 ms", "1.0e-12"),
        ("a-coarse", "2.0 ms", "1.0e-04"),
        ("b-coarse", "3.0 ms", "1.0e-05"),
        ("a-fine", "4.0 ms", "1.0e-08"),
        ("reference-fine", "5.0 ms", "1.0e-16"),
    ]
    assert table.rows[1].texts[3].endswith(HARMFUL)
    assert "×" not in table.rows[4].texts[3]
    assert to_png([shift]).startswith(b"\x89PNG")
    page, words, shown = to_html([present(shift)], ""), to_markdown([present(shift)]), StringIO()
    print_report(present(shift), Console(file=shown, width=200))
    for text in (page, words, shown.getvalue()):
        assert "the cheapest data that harm none of gns" in text
    assert page.index("What data cost") < page.index("What a change of engine, or of its settings")
    assert "4 [" in words.partition("What training data cost")[2]
