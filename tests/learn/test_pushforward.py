"""Windows that go on from a model's own prediction."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from mbds_xsim.learn.gns import GNS, GNSSettings
from mbds_xsim.learn.model import PointModel, build, pushed
from mbds_xsim.learn.sgnn import SGNN, SGNNSettings
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import Motions

Analytic = Callable[..., Motions]
LAST = torch.tensor([5, 9, 12, 7])
ROWS = torch.tensor([3, 0, 1, 2])
MODELS = {
    "gns": (GNS, GNSSettings(width=8, steps=1, noise=0.0)),
    "sgnn": (SGNN, SGNNSettings(hidden=8)),
}


def falling(time: Tensor) -> Tensor:
    return torch.cat([0.02 * time, 0.0 * time, -0.002 * time**2], dim=-1)


def trivial(name: str, motions: Motions) -> PointModel:
    model = build(name, motions.graph, Statistics.of(motions))
    assert isinstance(model, PointModel)
    return model


def untrained(name: str, motions: Motions) -> PointModel:
    kind, settings = MODELS[name]
    torch.manual_seed(0)
    model: PointModel = kind(motions.graph, Statistics.of(motions), settings).double()
    return model


def test_a_model_that_is_right_is_shown_later_windows(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    model = trivial("constant_acceleration", motions)
    later = pushed(model, motions.sample(ROWS, LAST, 3))
    expected = motions.sample(ROWS, LAST + torch.tensor([2, 1, 0, 0]), 1)
    assert torch.allclose(later.start.history, expected.start.history, rtol=0, atol=1e-14)
    assert torch.equal(later.position, expected.position)


def test_the_inputs_are_those_of_the_frame_to_come(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    motions.inputs.force[:] = torch.arange(19.0)[:, None, None]
    later = pushed(trivial("hold", motions), motions.sample(ROWS, LAST, 3))
    assert later.inputs.at(0).force[:, 0, 0].tolist() == [7.0, 10.0, 12.0, 7.0]


def test_what_a_wrong_model_is_to_do_leads_back_to_the_truth(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    sample = motions.sample(ROWS, LAST, 2)
    later = pushed(trivial("hold", motions), sample)
    assert torch.equal(later.start.history[:2, -1], sample.start.history[:2, -1])  # it held still
    assert torch.equal(later.position[:2, 0], sample.position[:2, 1])
    assert torch.equal(later.position[2:, 0], sample.position[2:, 0])


def test_with_one_frame_to_come_windows_stay_as_they_are(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    sample = motions.sample(ROWS, LAST, 1)
    later = pushed(trivial("hold", motions), sample)
    assert torch.equal(later.start.history, sample.start.history)
    assert torch.equal(later.position, sample.position)


@pytest.mark.parametrize("name", MODELS)
def test_a_batch_of_one_window_is_a_true_one(analytic: Analytic, name: str) -> None:
    motions = analytic("6pendulum", falling)
    later = pushed(untrained(name, motions), motions.sample(ROWS[:1], LAST[:1], 4))
    assert torch.equal(later.start.history, motions.sample(ROWS[:1], LAST[:1], 1).start.history)


@pytest.mark.parametrize("name", MODELS)
def test_the_loss_is_of_predicted_windows_as_if_they_were_given(
    analytic: Analytic, name: str
) -> None:
    motions = analytic("6pendulum", falling)
    sample, generator = motions.sample(ROWS, LAST, 2), torch.Generator()
    model = untrained(name, motions)
    own = pushed(model, sample)
    assert not own.start.history.requires_grad
    assert torch.equal(model.loss(sample, generator), model.loss(own, generator))
    plain = motions.sample(ROWS, LAST, 1)
    assert not torch.equal(model.loss(sample, generator), model.loss(plain, generator))
