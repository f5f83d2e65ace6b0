"""The shift study: gaps that are resolved, floors, and statistics against known ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.isolate import Conduct
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.learn.particles import EXPLODED
from mbds_xsim.learn.shift import rollouts
from mbds_xsim.learn.shift.answers import answers_of
from mbds_xsim.learn.shift.domains import (
    REFERENCE,
    Domain,
    ReferenceFrames,
    load_paired,
    solve_domain,
)
from mbds_xsim.learn.shift.evaluation import (
    ENGINE,
    RESTART,
    cells_of,
    chaos_floor,
    floors_of,
    nearest_engine,
    noise_floor,
)
from mbds_xsim.learn.shift.gaps import (
    LONELY,
    UNKNOWN,
    Draws,
    Resampler,
    bounds_of,
    kind_of,
    paper_errors,
    ranks_alike,
    why_unresolved,
)
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from tests.learn.evaluations import (
    COUNT,
    FRAMES,
    entry_of,
    evaluation,
    figures_of,
    measured_gaps,
    paired,
    shifted,
)


def test_a_perfect_model_has_no_gap_and_no_shift_is_resolved() -> None:
    gaps = measured_gaps(evaluation(lambda *_: np.zeros((COUNT, FRAMES)), floor=1.0))
    assert len(gaps) == 6
    for gap in gaps:
        assert gap.difference == gap.difference_low == gap.difference_high == (0.0, 0.0)
        assert gap.ratio == (None, None)
        assert gap.resolved == (False, False)
        assert gap.why == ("interval contains 0",) * 2


def test_a_shift_beyond_the_floor_is_resolved_and_measured() -> None:
    gaps = measured_gaps(evaluation(shifted, floor=100.0))
    for gap in gaps:
        assert gap.kind == "single"
        assert gap.seeds == (3, 3)
        assert gap.ratio[0] == pytest.approx(4.0)
        assert gap.ratio_low[0] is not None
        assert gap.ratio_high[0] is not None
        # Starts differ by more than e, but are drawn together: the ratio is known to 2 %.
        assert 3.9 < gap.ratio_low[0] <= 4.0 <= gap.ratio_high[0] < 4.1
        assert gap.resolved == (True, True)


def test_a_model_worse_than_the_engines_differ_resolves_nothing() -> None:
    gaps = measured_gaps(evaluation(shifted, floor=1e-3))
    assert {why for gap in gaps for why in gap.why} == {"own error exceeds the engine floor"}
    assert not any(resolved for gap in gaps for resolved in gap.resolved)


@pytest.mark.parametrize(
    ("own", "floor", "low", "high", "why"),
    [
        (1.0, 2.0, 0.5, 1.0, ""),
        (1.0, 2.0, -1.0, -0.5, ""),
        (3.0, 2.0, 0.5, 1.0, "own error exceeds the engine floor"),
        (1.0, 2.0, -0.5, 1.0, "interval contains 0"),
        (1.0, 2.0, 0.0, 1.0, "interval contains 0"),
        (1.0, 2.0, np.nan, np.nan, LONELY),
        (np.nan, 2.0, 0.5, 1.0, UNKNOWN),
        (1.0, np.nan, 0.5, 1.0, UNKNOWN),
    ],
)
def test_what_is_resolvable(own: float, floor: float, low: float, high: float, why: str) -> None:
    assert why_unresolved(own, floor, low, high) == why


def test_of_trainings_on_one_engine_no_shift_is_asked() -> None:
    study = evaluation(shifted, floor=100.0)
    alone = {key: value for key, value in study.figures.items() if key[0].training == "a-native"}
    study = dataclasses.replace(study, figures=alone)
    gaps = measured_gaps(study)
    assert gaps == []
    (answer,) = answers_of(Draws(study), gaps, FRAMES)
    assert "cannot be asked" in answer.answer


def test_a_restarted_engine_that_is_lost_does_not_widen_the_floor() -> None:
    """The restart's distance counts where it goes on, elsewhere that of the published motions."""
    study = evaluation(shifted, floor=0.5)
    error = np.full((COUNT, FRAMES), 0.25)
    error[0] = np.inf
    error[1] = 2.0 * study.largest
    restarted = {pair: figures_of(error) for pair in study.oracles}
    study = dataclasses.replace(study, restarted=restarted)
    floor, mean = study.floor("a-native", "b-native"), (2 * 0.5 + (COUNT - 2) * 0.25) / COUNT
    assert (floor[:2] == 0.5).all()
    assert (floor[2:] == 0.25).all()
    assert nearest_engine(study, "a-native") == pytest.approx(mean)
    told = [error for each in floors_of(study) if each.kind == RESTART for error in each.mse]
    assert told == pytest.approx([mean] * len(told))
    assert {why for gap in measured_gaps(study) for why in gap.why} == {
        "own error exceeds the engine floor"
    }


def test_kinds_of_gaps() -> None:
    every = ["a-native", "b-native", "c-native", "a-matched", "c-matched"]

    def kind(engines: tuple[str, ...], test: str) -> str:
        return kind_of(entry_of("any", 0, engines), test, every)

    assert kind(("a",), "a-native") == ""
    assert kind(("a",), "b-native") == "single"
    assert kind(("a",), "a-matched") == "single"
    assert kind(("a", "b"), "c-native") == "leave-one-out"
    assert kind(("a", "b"), "c-matched") == "leave-one-out"
    assert kind(("a", "b"), "a-native") == ""
    assert kind(("a", "b"), "a-matched") == ""
    assert kind(("a", "b", "c"), "b-native") == "all"


def test_lost_predictions_are_counted_never_dropped() -> None:
    def error(training: str, engine: str, _: int) -> Array:
        figures = np.full((COUNT, FRAMES), 1.0)
        if training != engine:
            figures[0] = np.inf
        return figures

    study = evaluation(error, floor=100.0)
    cell = next(c for c in cells_of(study) if (c.training, c.test) == ("a-native", "b-native"))
    assert cell.known == (COUNT, COUNT)
    assert cell.finite == (COUNT - 1, COUNT - 1)
    assert cell.diverged == (1, 1)
    gap = next(g for g in measured_gaps(study) if (g.training, g.test) == ("a-native", "b-native"))
    exploded = (EXPLODED * study.test.scene.length) ** 2
    assert gap.transferred[0] == pytest.approx((COUNT - 1 + exploded) / COUNT)
    assert cell.mse == pytest.approx(gap.transferred)


def test_a_prediction_that_exploded_and_came_back_stays_lost() -> None:
    exploded = (EXPLODED * paired(("a",)).scene.length) ** 2

    def error(training: str, engine: str, _: int) -> Array:
        figures = np.full((COUNT, FRAMES), 1.0)
        if training != engine:
            figures[0, 2] = 2.0 * exploded
        return figures

    study = evaluation(error, floor=100.0)
    cell = next(c for c in cells_of(study) if (c.training, c.test) == ("a-native", "b-native"))
    assert cell.diverged == (0, 1)
    assert cell.mse == pytest.approx((1.0, (COUNT - 1 + exploded) / COUNT))
    gap = next(g for g in measured_gaps(study) if (g.training, g.test) == ("a-native", "b-native"))
    assert gap.transferred == pytest.approx(cell.mse)
    unknown = np.array([[1.0, 2.0 * exploded, np.nan, 1.0, np.nan]])
    np.testing.assert_equal(study.exploded(unknown), [[False, True, False, True, False]])


def test_lost_restarts_are_counted_never_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three restarts of each trajectory; what is not known of the truth is no loss."""
    horizon, count = 20, 4
    position = torch.zeros(count, HISTORY + horizon, 1, 3)
    body = torch.zeros(count, HISTORY + horizon, 1, 13)
    position[1, HISTORY + 8] = torch.nan  # the truth of the second restart
    body[2, HISTORY + 7] = torch.nan  # its start
    starts = []

    def predicted(*job: object) -> torch.Tensor:
        frames, last = job[3:]
        assert frames == 1
        starts.append(last)
        result = torch.full((count, 1, 1, 3), 1e-3, dtype=torch.float64)
        if len(starts) == 2:
            result[:3] = torch.nan
        return result

    monkeypatch.setattr(rollouts, "_predicted", predicted)
    job: Any = SimpleNamespace(horizon=horizon)
    motions: Any = SimpleNamespace(position=position, body=body)
    errors = rollouts._one_step(job, motions, paired(("a",)).batch)
    assert starts == [HISTORY - 1, HISTORY + 7, HISTORY + 15]
    np.testing.assert_allclose(errors, [np.inf, 3e-6, 3e-6, 3e-6])
    figures = dataclasses.replace(figures_of(np.ones((count, FRAMES))), one_step=errors)
    whole = evaluation(lambda *_: np.ones((count, FRAMES)), floor=0.0)
    index = whole.test.index[:count]
    whole = dataclasses.replace(
        whole,
        test=dataclasses.replace(whole.test, index=index),
        oracles={},
        restarted={("a-native", "b-native"): figures},
    )
    (cell,) = (c for c in cells_of(whole) if c.model == RESTART and c.interval == "all")
    assert cell.one_step is None  # as a model's


def test_cells_are_told_by_interval_and_engines_are_models_too() -> None:
    error = np.repeat((np.arange(COUNT) % 3.0)[:, None], FRAMES, axis=1)
    study = evaluation(lambda *_: error, floor=2.0)
    cells = [c for c in cells_of(study) if (c.training, c.test, c.seed) == ("a-native",) * 2 + (0,)]
    assert {c.interval: c.mse[0] for c in cells} == {
        "all": 1.0, "low": 0.0, "medium": 1.0, "high": 2.0,
    }  # fmt: skip
    oracle = [c for c in cells_of(study) if c.model == ENGINE and c.interval == "all"]
    assert len(oracle) == 6
    assert {c.mse for c in oracle} == {(2.0, 2.0)}


def test_bootstrap_intervals_cover_the_mean() -> None:
    """Errors are log-normal, with known mean; 95 % nominal, less at this size and skewness."""
    rng = np.random.default_rng(3)
    count, trials = 80, 400
    spread, hit = 0.5, 0
    resampler = Resampler(count, draws=400)
    for _ in range(trials):
        errors = np.exp(spread * rng.standard_normal((1, count, 1)))
        low, high = bounds_of(resampler.means(errors, "any"))
        hit += bool(low[0] <= np.exp(0.5 * spread**2) <= high[0])
    assert 0.89 < hit / trials < 0.97


def test_bootstrap_draws_seeds_too_and_trajectories_together() -> None:
    rng = np.random.default_rng(4)
    hard = np.exp(rng.standard_normal((1, 50, 1)))
    resampler = Resampler(50)
    one, two = resampler.means(hard, "one"), resampler.means(2.0 * hard, "two")
    np.testing.assert_allclose(two, 2.0 * one)
    seeds = np.array([1.0, 2.0, 3.0])[:, None, None] * np.ones((1, 50, 1))
    low, high = bounds_of(resampler.means(seeds, "one"))
    rounding = 1e-12
    assert 1.0 - rounding <= low[0] < 1.7
    assert 2.3 < high[0] <= 3.0 + rounding


@pytest.mark.parametrize("axis", [0, 1])
def test_of_few_seeds_or_trajectories_means_spread_as_new_ones_would(axis: int) -> None:
    """The means' variance is the unbiased sample variance (n − 1) divided by n."""
    few = np.array([1.0, 2.0, 4.0])
    shape = (3, 5, 1) if axis == 0 else (1, 3, 1)
    errors = np.broadcast_to(few.reshape(-1, 1, 1) if axis == 0 else few[None, :, None], shape)
    means = Resampler(shape[1], draws=20_000).means(errors, "any")
    assert means.mean() == pytest.approx(few.mean(), rel=0.01)
    assert means.var() == pytest.approx(few.var(ddof=1) / 3, rel=0.05)


def test_floors_of_noise_and_chaos() -> None:
    test = paired(("a",))
    frames = HISTORY + FRAMES
    shape = (COUNT, frames, 2, 3)
    position = np.zeros(shape)
    quiet = np.zeros((COUNT, FRAMES, 2, 3))
    quiet[:, 2, :, 0] = 0.1
    growth = np.tile(2.0 ** np.arange(frames), (COUNT, 1))
    truth = ReferenceFrames(position, position, np.zeros((COUNT, frames, 1, 13)), quiet, growth)
    noise = noise_floor(truth, FRAMES)
    np.testing.assert_allclose(noise[:, 2], 0.01)
    assert (noise[:, [0, 1, 3, 4]] == 0.0).all()
    chaos = chaos_floor(test, truth, FRAMES)
    np.testing.assert_allclose(chaos[0], (1e-4 * 2.0 ** np.arange(1, FRAMES + 1)) ** 2)


def test_rank_agreement() -> None:
    first = {"gns": 1.0, "sgnn": 2.0, "hgnn": 3.0, "lgnn": 4.0}
    assert ranks_alike(first, first) == pytest.approx(1.0)
    assert ranks_alike(first, {name: -x for name, x in first.items()}) == pytest.approx(-1.0)
    swapped = first | {"gns": 2.5}
    assert ranks_alike(first, swapped) == pytest.approx(4.0 / 6.0)
    assert ranks_alike({"gns": 1.0, "sgnn": 2.0}, first) is None


def test_the_papers_figures_are_there_as_printed() -> None:
    errors = paper_errors("6pendulum")
    assert errors["gns", 1] == 0.0144
    assert {model for model, _ in errors} == {"gns", "sgnn", "hgnn", "lgnn"}
    assert paper_errors("no scene of the paper") == {}
    sound = paper_errors("6pendulum", flagged=False)
    assert set(errors) - set(sound) == {("lgnn", 50)}  # less than at t = 40


def test_the_truth_is_one_more_domain(tmp_path: Path) -> None:
    """The data that the reference made are the motions of the domain of no engine."""
    scene = msgspec.structs.replace(load_scene("2pendulum"), clock=Clock(0.02, 20))
    choice = Choice.parse(engines=f"mujoco,{REFERENCE}")
    generate(Request((scene,), choice, 60, tmp_path), workers=0)

    test = load_paired(tmp_path, "2pendulum")
    solved, _ = solve_domain(test, 10, Conduct(0, cache=False))

    assert [domain.name for domain in test.domains] == ["mujoco-matched", "reference-matched"]
    assert solved is not None
    domains: list[Domain] = [*test.domains, solved]
    motions = [each.motions(torch.float64).body for each in domains]
    engine, own, truth = (body[:, :16, :, :3] for body in motions if body is not None)
    assert float((own - truth).abs().max()) < 1e-10
    assert float((engine - truth).abs().max()) > 1e-9
