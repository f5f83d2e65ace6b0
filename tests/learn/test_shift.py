"""The shift study: figures against those computed by hand, statistics against known ones."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from mbds_xsim.base.arrays import Array
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import ConstantVelocity
from mbds_xsim.learn.particles import (
    EXPLODED,
    LOST,
    RigidPairs,
    RolloutFigures,
    measure,
    one_step_error,
)
from mbds_xsim.learn.shift.answers import answers_by_interval, answers_of
from mbds_xsim.learn.shift.domains import (
    REFERENCE,
    Domain,
    Paired,
    Recorded,
    ReferenceFrames,
    load_paired,
    solve_domain,
)
from mbds_xsim.learn.shift.evaluation import (
    ENGINE,
    Evaluation,
    cells_of,
    chaos_floor,
    noise_floor,
    valid_time,
)
from mbds_xsim.learn.shift.gaps import (
    UNKNOWN,
    Draws,
    Resampler,
    bounds_of,
    gaps_of,
    kind_of,
    paper_errors,
    ranks_alike,
    why_unresolved,
)
from mbds_xsim.learn.shift.result import Gap
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene

Analytic = Callable[..., Motions]
FRAMES = 5
COUNT = 12


@pytest.fixture
def fall(analytic: Analytic) -> Motions:
    """Balls that fall: z = −½ g t², with t in seconds."""
    frame = Graph.of(load_scene("balldrop")).frame_s

    def course(time: torch.Tensor) -> torch.Tensor:
        drop = -0.5 * 9.81 * (time * frame) ** 2
        return torch.cat([0.0 * drop, 0.0 * drop, drop], dim=-1)

    return analytic("balldrop", course)


def test_position_error_is_the_mean_squared_distance(fall: Motions) -> None:
    predicted = fall.position[:, HISTORY : HISTORY + FRAMES].clone()
    predicted[1] += torch.tensor([0.3, 0.0, 0.4])
    predicted[2, 3:] = torch.nan
    error = measure(fall, predicted).error
    assert error.shape == (4, FRAMES)
    np.testing.assert_allclose(error[0], 0.0, atol=1e-30)
    np.testing.assert_allclose(error[1], 0.25)
    assert np.isinf(error[2, 3:]).all()
    assert (error[2, :3] == 0.0).all()


def test_unknown_truth_is_not_a_lost_prediction(fall: Motions) -> None:
    predicted = fall.position[:, HISTORY : HISTORY + FRAMES].clone()
    fall.position[0, HISTORY + 2 :] = torch.nan
    figures = measure(fall, predicted)
    assert np.isnan(figures.error[0, 2:]).all()
    assert np.isfinite(figures.error[0, :2]).all()
    assert np.isnan(figures.energy[0, 2:]).all()


def test_energy_error_of_a_lifted_ball(fall: Motions) -> None:
    """Lifted by 1 cm from the second predicted frame on, it has m·g·1 cm too much later."""
    predicted = fall.position[:, HISTORY : HISTORY + FRAMES].clone()
    same = measure(fall, predicted).energy
    np.testing.assert_allclose(same, 0.0, atol=1e-12)
    predicted[..., 2] += 0.01
    truth = fall.position[:, HISTORY - 1 : HISTORY + FRAMES, :, 2]
    height = truth.mean(-1).numpy()
    rate = np.gradient(height, fall.graph.frame_s, axis=1)
    weight = 9.81 * float(fall.graph.mass.sum())
    kinetic = 0.5 * weight / 9.81 * rate**2
    scale = kinetic.max(axis=1) + weight * np.ptp(height, axis=1)
    scale = np.maximum(scale, 1e-3 * weight * fall.graph.length)
    found = measure(fall, predicted).energy[:, 2:]
    np.testing.assert_allclose(found, np.broadcast_to((weight * 0.01 / scale)[:, None], (4, 3)))


def test_rigid_pairs_of_a_pendulum_are_its_rods() -> None:
    graph = Graph.of(load_scene("3pendulum"))
    pairs = RigidPairs.of(graph)
    assert _pairs(pairs.first, pairs.second) == _pairs(graph.senders, graph.receivers)
    nodes = graph.reference.clone()
    assert float(pairs.gap(nodes)) < 1e-12
    stretched = nodes + 0.1 * (nodes - nodes[-1])
    longest = float(pairs.distance.max())
    assert float(pairs.gap(stretched)) == pytest.approx(0.1 * longest)


def _pairs(first: torch.Tensor, second: torch.Tensor) -> set[frozenset[int]]:
    return {frozenset(pair) for pair in torch.stack([first, second], 1).tolist()}


def test_rigid_pairs_of_a_ladder_keep_their_distance_in_true_motion() -> None:
    scene = load_scene("3ladder")
    graph = Graph.of(scene)
    batch = draw_batch(scene, range(6))
    from mbds_xsim.dataset.points import Points
    from mbds_xsim.scene.state import Trajectory

    states = {
        name: getattr(batch, name)[:, None]
        for name in ("position", "orientation", "velocity", "angular_velocity")
    }
    start = Trajectory(np.zeros(1), **states, failures=(None,) * 6)
    position, _ = Points.of(scene).motion(start)
    nodes = graph.with_anchors(graph.embed(torch.from_numpy(position)))
    pairs = RigidPairs.of(graph)
    assert len(pairs) > graph.particle_count
    assert float(pairs.gap(nodes).max()) < 1e-9


def test_a_body_of_one_particle_has_no_constraint_gap(fall: Motions, analytic: Analytic) -> None:
    figures = measure(fall, fall.position[:, HISTORY : HISTORY + FRAMES])
    assert (figures.gap < 1e-9).all()
    single = analytic("ballscroll", lambda time: torch.zeros(*time.shape[:-1], 3))
    figures = measure(single, single.position[:, HISTORY : HISTORY + FRAMES])
    assert np.isnan(figures.gap).all()


def test_one_step_error_of_constant_velocity_is_the_second_difference(fall: Motions) -> None:
    nothing: object = None
    model = ConstantVelocity(fall.graph, nothing, None)  # type: ignore[arg-type]
    found = one_step_error(model, fall, frames=8, stride=2)
    size = torch.linspace(0.5, 1.0, 4, dtype=torch.float64).numpy()
    step = size * 9.81 * fall.graph.frame_s**2
    np.testing.assert_allclose(found, step**2, rtol=1e-6)


def test_valid_time_is_that_of_the_last_frame_before_the_error_is_too_large() -> None:
    length, frame = 2.0, 0.02
    limit = (LOST * length) ** 2
    error = np.array(
        [
            [0.0, 0.5 * limit, 2.0 * limit, 0.0],
            [0.0, 0.0, 0.0, 0.0],
            [0.0, np.inf, np.inf, np.inf],
            [0.0, 0.0, np.nan, np.nan],
        ]
    )
    time, never = valid_time(error, length, frame)
    np.testing.assert_allclose(time, [2 * frame, 4 * frame, frame, 2 * frame])
    assert never.tolist() == [False, True, False, True]


# --- statistics on boards that are made up


def _set(engines: tuple[str, ...]) -> Paired:
    scene = load_scene("1pendulum")
    batch = draw_batch(scene, range(COUNT))
    domains = tuple(
        Recorded(name, "native", Path(name), tuple(range(COUNT)), name) for name in engines
    )
    return Paired(scene, batch.index, domains, batch, True, batch.force, seed=0, left_out={})


def _figures(error: Array) -> RolloutFigures:
    nothing = np.full_like(error, np.nan)
    return RolloutFigures(error, nothing, nothing, error[:, 0])


def _entry(training: str, seed: int, engines: tuple[str, ...]) -> TrainedModel:
    name = f"{training}-native"
    return TrainedModel("gns", name, engines, "native", seed, Path(f"{training}{seed}"), name, "")


def _board(error: Callable[[str, str, int], Array], floor: float) -> Evaluation:
    engines = ("a", "b", "c")
    test = _set(engines)
    figures = {
        (_entry(training, seed, (training,)), f"{engine}-native"): _figures(
            error(training, engine, seed)
        )
        for training in engines
        for seed in range(3)
        for engine in engines
    }
    oracles = {
        (f"{i}-native", f"{j}-native"): _figures(np.full((COUNT, FRAMES), floor))
        for i in engines
        for j in engines
        if i != j
    }
    return Evaluation(test, (1, FRAMES), figures, oracles)


def _gaps(board: Evaluation) -> list[Gap]:
    return list(gaps_of(Draws(board)))


def test_a_perfect_model_has_no_gap_and_no_shift_is_resolved() -> None:
    gaps = _gaps(_board(lambda *_: np.zeros((COUNT, FRAMES)), floor=1.0))
    assert len(gaps) == 6
    for gap in gaps:
        assert gap.difference == gap.difference_low == gap.difference_high == (0.0, 0.0)
        assert gap.ratio == (None, None)
        assert gap.resolved == (False, False)
        assert gap.why == ("interval contains 0",) * 2


def _shifted(training: str, engine: str, seed: int) -> Array:
    rng = np.random.default_rng(ord(engine))
    hard = np.exp(rng.standard_normal((COUNT, 1)))  # some starts are harder, for all models
    away = 0.0 if training == engine else 3.0
    return np.tile((1.0 + away) * hard * (1.0 + 0.01 * seed), (1, FRAMES))


def test_a_shift_beyond_the_floor_is_resolved_and_measured() -> None:
    gaps = _gaps(_board(_shifted, floor=100.0))
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
    gaps = _gaps(_board(_shifted, floor=1e-3))
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
        (1.0, 2.0, np.nan, np.nan, "interval contains 0"),
        (np.nan, 2.0, 0.5, 1.0, UNKNOWN),
        (1.0, np.nan, 0.5, 1.0, UNKNOWN),
    ],
)
def test_what_is_resolvable(own: float, floor: float, low: float, high: float, why: str) -> None:
    assert why_unresolved(own, floor, low, high) == why


def test_a_model_whose_own_domain_is_not_tested_resolves_nothing() -> None:
    board = _board(_shifted, floor=100.0)
    fewer = [domain for domain in board.test.domains if domain.engine != "a"]
    test = dataclasses.replace(board.test, domains=tuple(fewer))
    seen = {key: value for key, value in board.figures.items() if key[1] != "a-native"}
    apart = {key: value for key, value in board.oracles.items() if "a-native" not in key}
    board = Evaluation(test, board.frames, seen, apart)
    gaps = _gaps(board)
    assert {gap.training for gap in gaps if not all(gap.resolved)} == {"a-native"}
    assert {why for gap in gaps if gap.training == "a-native" for why in gap.why} == {UNKNOWN}
    told = next(answers_of(Draws(board), gaps, FRAMES)).answer
    assert "2 of 4 shifts from one engine's data to another's are resolved: 2 times the" in told
    assert "2 because the model's own domain is not tested. Of 2 intervals at 95 %" in told
    near = {pair: _figures(np.zeros((COUNT, FRAMES))) for pair in apart}
    assert "this cannot be told" in _answer(dataclasses.replace(board, oracles=near))


def test_of_trainings_on_one_engine_no_shift_is_asked() -> None:
    board = _board(_shifted, floor=100.0)
    alone = {key: value for key, value in board.figures.items() if key[0].training == "a-native"}
    board = dataclasses.replace(board, figures=alone)
    gaps = _gaps(board)
    assert gaps == []
    (told,) = answers_of(Draws(board), gaps, FRAMES)
    assert "cannot be asked" in told.answer


def test_a_restarted_engine_that_is_lost_does_not_widen_the_floor() -> None:
    """Where it goes on its distance counts, elsewhere that of the published motions."""
    board = _board(_shifted, floor=0.5)
    error = np.full((COUNT, FRAMES), 0.25)
    error[0] = np.inf
    error[1] = 2.0 * board.largest
    restarted = {pair: _figures(error) for pair in board.oracles}
    board = dataclasses.replace(board, restarted=restarted)
    floor = board.floor("a-native", "b-native")
    assert (floor[:2] == 0.5).all()
    assert (floor[2:] == 0.25).all()
    assert {why for gap in _gaps(board) for why in gap.why} == {
        "own error exceeds the engine floor"
    }


def test_kinds_of_gaps() -> None:
    every = ["a-native", "b-native", "c-native", "a-matched", "c-matched"]

    def kind(engines: tuple[str, ...], test: str) -> str:
        return kind_of(_entry("any", 0, engines), test, every)

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

    board = _board(error, floor=100.0)
    cell = next(c for c in cells_of(board) if (c.training, c.test) == ("a-native", "b-native"))
    assert cell.known == (COUNT, COUNT)
    assert cell.finite == (COUNT - 1, COUNT - 1)
    assert cell.diverged == (1, 1)
    gap = next(g for g in _gaps(board) if (g.training, g.test) == ("a-native", "b-native"))
    exploded = (EXPLODED * board.test.scene.length) ** 2
    assert gap.transferred[0] == pytest.approx((COUNT - 1 + exploded) / COUNT)
    assert cell.mse == pytest.approx(gap.transferred)


def test_cells_are_told_by_interval_and_engines_are_models_too() -> None:
    error = np.repeat((np.arange(COUNT) % 3.0)[:, None], FRAMES, axis=1)
    board = _board(lambda *_: error, floor=2.0)
    cells = [c for c in cells_of(board) if (c.training, c.test, c.seed) == ("a-native",) * 2 + (0,)]
    assert {c.interval: c.mse[0] for c in cells} == {
        "all": 1.0, "low": 0.0, "medium": 1.0, "high": 2.0,
    }  # fmt: skip
    oracle = [c for c in cells_of(board) if c.model == ENGINE and c.interval == "all"]
    assert len(oracle) == 6
    assert {c.mse for c in oracle} == {(2.0, 2.0)}


def _answer(board: Evaluation) -> str:
    draws = Draws(board)
    gaps = _gaps(board)
    found = {answer.question: answer.answer for answer in answers_of(draws, gaps, FRAMES)}
    return found["Which model is most robust (native)?"]


def test_no_model_is_called_robust_where_no_shift_is_resolved() -> None:
    told = _answer(_board(_shifted, floor=1e-3))
    assert "this cannot be told" in told
    assert "Gaps resolved: 0 of 6 of gns" in told
    told = _answer(_board(_shifted, floor=100.0))
    assert "gns has the smallest worst-engine gap" in told
    assert "Gaps resolved: 6 of 6 of gns" in told
    assert "gns 4 [" in told


def test_a_model_that_is_worse_than_the_engines_differ_is_not_called_robust() -> None:
    good, bad = (
        _board(_shifted, floor=100.0),
        _board(lambda *_: np.full((COUNT, FRAMES), 1e3), 1.0),
    )
    weak = {
        (dataclasses.replace(entry, model="sgnn"), name): value
        for (entry, name), value in bad.figures.items()
    }
    told = _answer(Evaluation(good.test, good.frames, {**good.figures, **weak}, good.oracles))
    assert "gns has the smallest worst-engine gap; sgnn cannot be judged" in told
    assert "sgnn 1 [1, 1]" in told
    assert "Gaps resolved: 6 of 6 of gns, 0 of 6 of sgnn" in told


def test_resolved_gains_are_not_told_as_losses() -> None:
    def error(training: str, engine: str, seed: int) -> Array:
        figures = _shifted(training, engine, seed)
        return figures / 16.0 if (training, engine) == ("a", "b") else figures

    board = _board(error, floor=100.0)
    gaps = _gaps(board)
    told = next(answers_of(Draws(board), gaps, FRAMES)).answer
    assert "6 of 6 shifts" in told
    assert "5 times the model errs more than the one trained there, 1 times less" in told


def test_a_model_that_errs_as_much_at_home_is_not_harmed_by_the_change() -> None:
    """The gap to the target's model is that of the data they were given."""

    def error(training: str, engine: str, seed: int) -> Array:
        if training == "c":
            return np.full((COUNT, FRAMES), 9.0 if engine == "c" else 8.0)
        return _shifted(training, engine, seed) / 4.0

    board = _board(error, floor=100.0)
    told = next(answers_of(Draws(board), _gaps(board), FRAMES)).answer
    assert "than the one trained there (in 2 of these no more than at home: its data" in told
    board = _board(_shifted, floor=100.0)
    assert "at home" not in next(answers_of(Draws(board), _gaps(board), FRAMES)).answer


def test_only_resolved_gaps_tell_which_model_is_most_robust() -> None:
    """A pair whose engines differ by less than the model errs has the worst ratio of all."""

    def error(training: str, engine: str, seed: int) -> Array:
        figures = _shifted(training, engine, seed)
        return 10.0 * figures if (training, engine) == ("a", "b") else figures

    board = _board(error, floor=100.0)
    near = {("a-native", "b-native"): _figures(np.zeros((COUNT, FRAMES)))}
    told = _answer(dataclasses.replace(board, oracles={**board.oracles, **near}))
    assert "Gaps resolved: 5 of 6 of gns" in told
    assert "gns 4 [" in told


def test_of_several_engines_the_one_that_bounds_the_error_best_is_told() -> None:
    """√R_ij ≤ √R_ii + √D_ij holds for each of them; the least bound decides."""
    errors = {"a": 0.09, "b": 0.01, "c": 0.04}
    board = _board(lambda _, engine, __: np.full((COUNT, FRAMES), errors[engine]), floor=1.0)
    entry = _entry("not-c", 0, ("a", "b"))
    figures = {
        (entry, f"{engine}-native"): _figures(np.full((COUNT, FRAMES), error))
        for engine, error in errors.items()
    }
    near = {("a-native", "c-native"): _figures(np.full((COUNT, FRAMES), 0.16))}
    board = Evaluation(
        board.test,
        board.frames,
        {**board.figures, **figures},
        {**board.oracles, **near},
    )
    gap = next(gap for gap in _gaps(board) if gap.kind == "leave-one-out")
    assert (gap.own[0], gap.engine_floor[0]) == (0.09, 0.16)  # 0.3 + 0.4, not 0.1 + 1
    assert gap.why[0] == "interval contains 0"


def test_seeds_of_one_number_are_drawn_together() -> None:
    """What a seed does to all trainings alike cancels in their ratio."""

    def error(training: str, engine: str, seed: int) -> Array:
        return 0.01 * _shifted(training, engine, 0) * (1.0 + seed)

    for gap in _gaps(_board(error, floor=1e3)):
        assert gap.ratio_low[0] == pytest.approx(4.0)
        assert gap.ratio_high[0] == pytest.approx(4.0)


def test_two_engines_less_one_are_told_once() -> None:
    board = _board(_shifted, floor=100.0)
    tested = ("a-native", "b-native")
    figures = {key: value for key, value in board.figures.items() if key[0].training in tested}
    for (entry, name), value in list(figures.items()):
        other = {"a": "not-b", "b": "not-a"}[entry.engines[0]]
        figures[_entry(other, entry.seed, entry.engines), name] = value
    domains = tuple(domain for domain in board.test.domains if domain.name in tested)
    test = dataclasses.replace(board.test, domains=domains)
    gaps = _gaps(Evaluation(test, board.frames, figures, board.oracles))
    assert [(gap.training, gap.test) for gap in gaps] == [
        ("a-native", "b-native"),
        ("b-native", "a-native"),
    ]


def test_all_engines_means_all_where_some_engine_is_not_tested() -> None:
    board = _board(_shifted, floor=100.0)
    tested = ("a-native", "b-native")
    domains = tuple(domain for domain in board.test.domains if domain.name in tested)
    figures = {key: value for key, value in board.figures.items() if key[1] in tested}
    for name, engines, error in (("not-c", ("a", "b"), 50.0), ("all", ("a", "b", "c"), 1e-3)):
        entry = _entry(name, 0, engines)
        figures |= {(entry, test): _figures(np.full((COUNT, FRAMES), error)) for test in tested}
    test = dataclasses.replace(board.test, domains=domains)
    board = Evaluation(test, board.frames, figures, board.oracles)
    found = _answers(board)
    assert "helps" in found["Does training on all engines help gns (native)?"]


def _of_variants(away: dict[str, float], spread: float) -> Evaluation:
    """Two engines, natively and matched; errors away from home are so many times those at home."""
    test = _set(("a", "b"))
    parts = [dataclasses.replace(d, variant=v) for v in away for d in test.domains]
    test = dataclasses.replace(test, domains=tuple(parts))
    figures, rng = {}, np.random.default_rng(5)
    for home, seed in itertools.product(parts, range(3)):
        entry = TrainedModel(
            "gns", home.name, (home.engine,), home.variant, seed, Path(f"{home.name}{seed}"), "", ""
        )
        for domain in parts:
            luck = np.exp(spread * rng.standard_normal((COUNT, 1)) * (home.variant == "matched"))
            error = luck * (1.0 if domain is home else away[home.variant])
            figures[entry, domain.name] = _figures(np.tile(error, (1, FRAMES)))
    pairs = itertools.permutations([domain.name for domain in parts], 2)
    apart = {pair: _figures(np.full((COUNT, FRAMES), 100.0)) for pair in pairs}
    return Evaluation(test, (1, FRAMES), figures, apart)


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
    board = _of_variants({"native": native, "matched": matched}, spread)
    found = _answers(board)
    assert says in found["Does matched data remove the shift of gns?"]


def test_changes_of_engine_are_counted_apart_from_those_of_settings() -> None:
    """Of 12 pairs of four domains 4 are of two engines at the same settings."""
    board = _of_variants({"native": 4.0, "matched": 1.0}, 0.0)
    told = next(answers_of(Draws(board), _gaps(board), FRAMES)).answer
    apart = "of 12 shifts from one engine's data to another's are resolved (2 of 4 at the same "
    assert f"{apart}settings, " in told
    assert " of 8 from other settings)" in told


def _answers(board: Evaluation) -> dict[str, str]:
    return {a.question: a.answer for a in answers_of(Draws(board), _gaps(board), FRAMES)}


def _of_matched_data(board: Evaluation, oracles: dict[tuple[str, str], RolloutFigures]) -> str:
    found = _answers(dataclasses.replace(board, oracles=oracles))
    return found["Does matched data remove the shift of gns?"]


def test_matched_data_remove_no_shift_of_a_model_that_shows_none() -> None:
    board = _of_variants({"native": 4.0, "matched": 1.0}, 0.0)
    same = {pair: _figures(np.zeros((COUNT, FRAMES))) for pair in board.oracles}
    told = _of_matched_data(board, same)
    assert "this cannot be told: where no gap is resolved" in told
    assert "Mean gap ratio 4 [4, 4] on native" in told


def test_what_is_not_resolved_on_matched_data_is_no_shift() -> None:
    """However sure it is that errors differ there, if engines differ by less than these."""
    board = _of_variants({"native": 4.0, "matched": 2.0}, 0.0)
    oracles = {
        pair: _figures(np.zeros((COUNT, FRAMES))) if all("matched" in n for n in pair) else apart
        for pair, apart in board.oracles.items()
    }
    told = _of_matched_data(board, oracles)
    assert "no shift is resolved on matched data, whose engines differ by less than" in told
    assert "2 [2, 2] on matched data" in told


def test_what_a_change_of_speed_costs() -> None:
    """Trained on another interval, models err 9 times as much, in medium starts 25 times."""
    board = _board(_shifted, floor=1.0)
    figures = dict(board.figures)
    place = np.arange(COUNT) % 3
    hard = np.exp(np.random.default_rng(2).standard_normal(COUNT))
    for own, interval in enumerate(("low", "medium", "high")):
        away = np.where(place == own, 1.0, np.where(place == 1, 25.0, 9.0))
        entry = dataclasses.replace(_entry(f"a-{interval}", 0, ("a",)), interval=interval)
        error = np.tile((0.01 * hard * away)[:, None], (1, FRAMES))
        for engine in ("a", "b", "c"):
            figures[entry, f"{engine}-native"] = _figures(error)
    whole = Evaluation(board.test, board.frames, figures, board.oracles)
    (answer,) = answers_by_interval(whole, FRAMES)
    assert answer.question == "What does a change of speed cost (a-native)?"
    ratio = answer.ratios["gns"]
    for bound in (ratio.low, ratio.value, ratio.high):
        assert bound == pytest.approx((25.0, 25.0))
    assert _gaps(whole) == _gaps(board)
    assert list(answers_by_interval(board, FRAMES)) == []


def test_bootstrap_intervals_cover_the_mean() -> None:
    """Of log-normal errors, whose mean is known; 95 % nominal, less at this size and skewness."""
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


def test_floors_of_noise_and_chaos() -> None:
    test = _set(("a",))
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
    """The data that the reference made are the motions of the domain that nobody made."""
    scene = msgspec.structs.replace(load_scene("2pendulum"), clock=Clock(0.02, 20))
    choice = Choice.parse(engines=f"mujoco,{REFERENCE}")
    generate(Request((scene,), choice, 60, tmp_path), workers=0)

    test = load_paired(tmp_path, "2pendulum")
    solved, _ = solve_domain(test, 10, cache=False, workers=0)

    assert [domain.name for domain in test.domains] == ["mujoco-matched", "reference-matched"]
    assert solved is not None
    domains: list[Domain] = [*test.domains, solved]
    motions = [each.motions(torch.float64).body for each in domains]
    engine, own, truth = (body[:, :16, :, :3] for body in motions if body is not None)
    assert float((own - truth).abs().max()) < 1e-10
    assert float((engine - truth).abs().max()) > 1e-9
