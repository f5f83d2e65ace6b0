"""Horizons from the first contact: its frame, and figures that count from it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from mbds_xsim.learn.curves import LearningCurve, write_curve
from mbds_xsim.learn.model import load_model
from mbds_xsim.learn.shift import contact
from mbds_xsim.learn.shift.evaluation import nearest_engine, seconds_to_floor
from mbds_xsim.learn.shift.gaps import Draws
from mbds_xsim.learn.shift.interaction import (
    answer_of_factors,
    answers_of_interactions,
    interactions_of,
)
from mbds_xsim.learn.train import CurvePoint
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.models import motions_of

from .evaluations import COUNT, entry_of, evaluation, figures_of, paired

_LONG = 40


@dataclasses.dataclass(frozen=True)
class _Made:
    """A domain whose motions are given."""

    made: Motions

    def motions(self, dtype: torch.dtype) -> Motions:
        assert dtype == torch.float64
        return self.made


def _falling(*touches: int) -> _Made:
    """Discs that come down evenly, and touch the ground at so many frames from the first."""
    motions = motions_of(load_model("gns+"), load_scene("balldrop"), rows=len(touches), frames=30)
    assert motions.body is not None
    body, frame = motions.body.clone(), torch.arange(motions.body.shape[1])
    radius = motions.graph.mechanism.sphere_radius[0]
    body[..., 7:] = 0.0
    body[..., 9] = -0.1 / motions.graph.frame_s
    for row, touch in enumerate(touches):
        body[row, :, 0, 2] = radius + 0.1 * (touch - 0.5 - frame)
    return _Made(dataclasses.replace(motions, body=body))


def test_the_first_contact_is_that_of_the_earliest_domain() -> None:
    ball = dataclasses.replace(paired(("a",)), scene=load_scene("balldrop"), index=np.arange(3))
    domains: Any = (_falling(12, 20, 99), _falling(14, 18, 99))
    frames = contact.first_contact(dataclasses.replace(ball, domains=domains), 20)
    assert frames.tolist() == [12 - HISTORY, 18 - HISTORY, 20]
    inside: Any = (_falling(2, 12, 12),)
    frames = contact.first_contact(dataclasses.replace(ball, domains=inside), 20)
    assert frames[0] == -1


def test_a_bounce_between_two_frames_is_a_contact() -> None:
    """The disc is in the air at every frame, and turns back after frame 9."""
    domain = _falling(10)
    assert domain.made.body is not None
    domain.made.body[:, 10:, 0, 2] = domain.made.body[:, 9:10, 0, 2]
    domain.made.body[:, 10:, 0, 9] *= -1.0
    ball = dataclasses.replace(paired(("a",)), scene=load_scene("balldrop"), index=np.arange(1))
    domains: Any = (domain,)
    frames = contact.first_contact(dataclasses.replace(ball, domains=domains), 20)
    assert frames.tolist() == [10 - HISTORY]


def test_scenes_without_a_ground_have_none() -> None:
    assert contact.first_contact(paired(("a",)), 7).tolist() == [7] * COUNT
    assert contact.from_contact(evaluation(lambda *_: np.ones((COUNT, 5)), floor=0.0)) is None


def test_all_figures_count_from_the_first_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trajectories that touch too late are left out; rising errors are read from the contact on."""
    rising = 0.1 * np.arange(1.0, _LONG + 1) + np.zeros((COUNT, 1))
    evaluated = evaluation(lambda *_: rising, floor=0.0)
    evaluated = dataclasses.replace(evaluated, frames=(1, 10, 20, _LONG), oracles={})
    first = np.array([*range(5, 16), _LONG])
    monkeypatch.setattr(contact, "first_contact", lambda *_: first)
    later = contact.from_contact(evaluated)
    assert later is not None
    assert later.frames == (1, 10, 20)
    assert later.test.index.tolist() == evaluated.test.index[:-1].tolist()
    errors = later.errors(later.entries[0], "a-native")
    there = first[:-1, None] + np.array([1.0, 10.0, 20.0])
    np.testing.assert_allclose(errors[0], 0.1 * there)
    rising[0, 0] = 2.0 * evaluated.largest  # and comes back before its contact
    lost = contact.from_contact(evaluated)
    assert lost is not None
    errors = lost.errors(lost.entries[0], "a-native")
    np.testing.assert_allclose(errors[0, 0], evaluated.largest)
    np.testing.assert_allclose(errors[0, 1:], 0.1 * there[1:])


def test_what_a_model_notices_is_counted_from_the_first_contact(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Engines that are alike in flight part by more than the model's error once balls touch."""
    apart = np.where(np.arange(_LONG) < 12, 0.1, 3.0) + np.zeros((COUNT, 1))
    evaluated = evaluation(lambda *_: np.ones((COUNT, _LONG)), floor=0.0)
    oracles = {pair: figures_of(apart) for pair in evaluated.oracles}
    evaluated = dataclasses.replace(evaluated, frames=(1, 10, _LONG), oracles=oracles)
    monkeypatch.setattr(contact, "first_contact", lambda *_: np.full(COUNT, 11))
    later = contact.from_contact(evaluated)
    assert later is not None
    for each, noticed in ((evaluated, (False, False, True)), (later, (False, True))):
        interactions = interactions_of(Draws(each))
        assert {one.noticed for one in interactions} == {noticed}


def test_changes_stand_side_by_side_in_one_sentence() -> None:
    """The answer says where frames are counted from."""
    interactions = interactions_of(Draws(evaluation(lambda i, j, _: _loss(i, j), floor=0.0)))
    (answer,) = answers_of_interactions(interactions, 0, 1, " after the first contact")
    assert answer.question.endswith("on native data after the first contact?")
    assert list(answer_of_factors(interactions, 0, 1)) == []  # there is one change
    other = [_matched(each) for each in interactions]
    (both,) = answer_of_factors([*interactions, *other], 0, 1)
    assert both.answer == (
        "At t = 1 the squared error of gns grows significantly by up to 4-fold with another engine "
        "on native data, 4-fold with another engine on matched data"
    )
    (both,) = answer_of_factors([*interactions, *map(_unresolved, other)], 0, 1)
    assert both.answer == (
        "At t = 1 the squared error of gns grows significantly by up to 4-fold with another engine "
        "on native data; by how much cannot be told with another engine on matched data"
    )
    (none,) = answer_of_factors(list(map(_unresolved, [*interactions, *other])), 0, 1)
    assert none.answer == (
        "At t = 1 it cannot be told by how much the squared error of gns grows with another engine "
        "on native data, with another engine on matched data"
    )


@pytest.mark.parametrize(
    ("pairs", "says"),
    [
        ([(1.5, 1.9, True), (1.0, 1.99, False)], "less than 2-fold, if at all, with another"),
        ([(1.002, 1.004, True), (1.0, 1.9, False)], "less than 2-fold, if at all, with another"),
        ([(1.5, 1.9, True), (1.0, 2.0, False)], "cannot be told with another"),
        ([(1.5, 1.9, True), (1.0, None, False)], "cannot be told with another"),
        ([(1.98, 2.4, True), (1.5, 1.9, True)], "cannot be told with another"),
        ([(2.0, 2.5, True), (1.7, 6.6, False)], "significantly by up to 2-fold with another"),
    ],
)
def test_a_cost_is_told_only_as_far_as_all_intervals_show_it(
    pairs: list[tuple[float, float | None, bool]], says: str
) -> None:
    """Beside it is a change that costs nothing."""
    first, *rest = interactions_of(Draws(evaluation(lambda i, j, _: _loss(i, j), floor=0.0)))
    free = msgspec.structs.replace(_matched(first), value=(1.0,), high=(1.0,), resolved=(False,))
    made = [
        msgspec.structs.replace(each, value=(value,), high=(high,), resolved=(resolved,))
        for each, (value, high, resolved) in zip((first, *rest), pairs, strict=False)
    ]
    (answer,) = answer_of_factors([free, *made], 0, 1)
    assert f"{says} engine on native data" in answer.answer
    most = max((value for value, _, resolved in pairs if resolved), default=1.0)
    told = f"engine on native data (significant: {most:g}-fold)"
    assert (told in answer.answer) == (1.0 < most < 2.0)
    assert "another engine on matched data" in answer.answer.partition("if at all, ")[2]


def _unresolved(each: Any) -> Any:
    return msgspec.structs.replace(each, resolved=(False, False))


def _matched(each: Any) -> Any:
    """The same pair at matched settings."""
    names = (name.replace("native", "matched") for name in (each.first, each.second))
    return msgspec.structs.replace(each, **dict(zip(("first", "second"), names, strict=True)))


def _loss(training: str, engine: str) -> np.ndarray:
    hard = np.random.default_rng(ord(engine)).random((COUNT, 1)) + 1.0
    return np.tile(hard * (1.0 if training == engine else 4.0), (1, 5))


def test_the_engine_floor_is_reached_at_a_share_of_the_processor_time(tmp_path: Path) -> None:
    evaluated = evaluation(lambda *_: np.ones((COUNT, 5)), floor=0.0)
    near, far = (figures_of(np.full((COUNT, 5), value)) for value in (0.2, 0.7))
    apart = {("b-native", "a-native"): far, ("c-native", "a-native"): near}
    evaluated = dataclasses.replace(evaluated, restarted=apart)
    assert nearest_engine(evaluated, "a-native") == pytest.approx(0.2)
    run = entry_of("a", 0, ("a",))
    run = dataclasses.replace(run, path=tmp_path / "a-s0.pt", facts={"cpu_s": "60"})
    assert seconds_to_floor(evaluated, run) is None  # no learning curve is stored with it
    fell = ((10, 0.5), (20, 0.1), (40, 0.05))
    points = [CurvePoint(step, 1.0, error, 1e-3) for step, error in fell]
    curve = LearningCurve("a", 40, "steps", points)
    (tmp_path / "a-s0.curve.json").write_bytes(write_curve(curve))
    assert seconds_to_floor(evaluated, run) == pytest.approx(30.0)
