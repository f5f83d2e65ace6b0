"""Windows that go on from a model's own prediction."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest
import torch
from torch import Tensor

from mbds_xsim.errors import InputError
from mbds_xsim.learn.gns import GNS, GNSSettings
from mbds_xsim.learn.model import PointModel, build
from mbds_xsim.learn.pushforward import pushed
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


def untrained(name: str, motions: Motions, part: float) -> PointModel:
    kind, settings = MODELS[name]
    chosen = msgspec.structs.replace(settings, pushed=part)
    torch.manual_seed(0)
    model: PointModel = kind(motions.graph, Statistics.of(motions), chosen).double()
    return model


def test_a_model_that_is_right_is_shown_the_next_windows(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    model = build("constant_acceleration", motions.graph, Statistics.of(motions))
    assert isinstance(model, PointModel)
    found = pushed(model, motions.sample(ROWS, LAST, 2), 0.5)
    expected = motions.sample(ROWS, LAST + torch.tensor([1, 1, 0, 0]), 1)
    assert torch.allclose(found.start.history, expected.start.history, rtol=0, atol=1e-14)
    assert torch.equal(found.position[:, 0], expected.position[:, 0])
    assert found.inputs.force.shape == expected.inputs.force.shape


def test_the_inputs_are_those_of_the_frame_to_come(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    motions.inputs.force[:] = torch.arange(19.0)[:, None, None]
    model = build("hold", motions.graph, Statistics.of(motions))
    assert isinstance(model, PointModel)
    found = pushed(model, motions.sample(ROWS, LAST, 2), 0.5)
    assert found.inputs.at(0).force[:, 0, 0].tolist() == [6.0, 10.0, 12.0, 7.0]


def test_what_a_wrong_model_is_to_do_leads_back_to_the_truth(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    model = build("hold", motions.graph, Statistics.of(motions))
    assert isinstance(model, PointModel)
    sample = motions.sample(ROWS, LAST, 2)
    found = pushed(model, sample, 1.0)
    assert torch.equal(found.start.history[:, -1], sample.start.history[:, -1])  # it held still
    assert torch.equal(found.position[:, 0], sample.position[:, 1])


@pytest.mark.parametrize("name", MODELS)
def test_no_gradient_passes_through_the_prediction(analytic: Analytic, name: str) -> None:
    motions = analytic("6pendulum", falling)
    model = untrained(name, motions, 0.5)
    found = pushed(model, motions.sample(ROWS, LAST, 2), 0.5)
    assert not found.start.history.requires_grad


@pytest.mark.parametrize("name", MODELS)
def test_the_loss_is_of_pushed_and_true_windows(analytic: Analytic, name: str) -> None:
    motions = analytic("6pendulum", falling)
    sample, generator = motions.sample(ROWS, LAST, 2), torch.Generator().manual_seed(0)
    mixed, plain = untrained(name, motions, 0.5), untrained(name, motions, 0.0)
    own = pushed(plain, sample, 0.5)
    assert torch.equal(mixed.loss(sample, generator), plain.loss(own, generator))
    assert not torch.equal(mixed.loss(sample, generator), plain.loss(sample, generator))


def test_one_frame_to_come_is_too_few(analytic: Analytic) -> None:
    motions = analytic("6pendulum", falling)
    with pytest.raises(InputError, match="windows of 1 frame to come, needed are 2"):
        pushed(untrained("gns", motions, 0.5), motions.sample(ROWS, LAST, 1), 0.5)
