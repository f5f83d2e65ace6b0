"""Trivial models are exact on the motions they suppose, and only on those."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from mbds_xsim.base.errors import InputError, UnknownName
from mbds_xsim.learn.model import Hold, build, load_model, rollout
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs, Motions
from tests.learn.models import squared_error

Analytic = Callable[..., Motions]
TRIVIAL = ("hold", "constant_velocity", "constant_acceleration")


def _still(time: Tensor) -> Tensor:
    return torch.zeros_like(time).expand(-1, -1, 3)


def _uniform(time: Tensor) -> Tensor:
    return torch.cat([0.02 * time, -0.01 * time, 0.03 * time], dim=-1)


def _falling(time: Tensor) -> Tensor:
    return torch.cat([0.02 * time, 0.0 * time, -0.002 * time**2], dim=-1)


COURSES = (_still, _uniform, _falling)


@pytest.mark.parametrize("scene", ["6pendulum", "ballscroll", "balldrop"])
@pytest.mark.parametrize("order", [0, 1, 2])
def test_each_is_exact_up_to_its_order(analytic: Analytic, scene: str, order: int) -> None:
    for course in COURSES:
        motions = analytic(scene, course)
        model = build(TRIVIAL[order], motions.graph, Statistics.of(motions))
        error = squared_error(model, motions)
        moves = bool((motions.position.diff(dim=1) != 0).any())
        curves = bool((motions.position.diff(n=2, dim=1).abs() > 1e-9).any())
        exact = (not moves, not curves, True)[order]
        assert (float(error.max()) < 1e-20) == exact


def test_in_free_fall_constant_velocity_errs_by_the_known_amount(analytic: Analytic) -> None:
    motions = analytic("balldrop", _falling, rows=1)
    model = build("constant_velocity", motions.graph, Statistics.of(motions))
    error = squared_error(model, motions, steps=10)[0]
    frame = torch.arange(1, 11, dtype=torch.float64)
    # The lag is the second difference times 1 + 2 + … + n.
    step = float(motions.position[0, :3, 0, 2].diff(n=2))
    torch.testing.assert_close(error, (step * frame * (frame + 1) / 2) ** 2)


def test_batches_do_not_change_a_rollout(analytic: Analytic) -> None:
    motions = analytic("6pendulum", _falling, rows=5)
    model = build("constant_acceleration", motions.graph, Statistics.of(motions))
    together, apart = rollout(model, motions), rollout(model, motions, batch=2)
    assert torch.equal(together, apart)


def test_what_is_not_finite_is_counted_and_spoils_no_other(analytic: Analytic) -> None:
    motions = analytic("6pendulum", _uniform)
    model = build("constant_velocity", motions.graph, Statistics.of(motions))
    clean = rollout(model, motions)
    motions.position[1, 3] = torch.inf
    motions.position[1, 5] = torch.inf
    spoilt = rollout(model, motions)
    assert spoilt[:, -1].isfinite().flatten(1).all(1).tolist() == [True, False, True, True]
    assert spoilt[1].isnan().all()
    assert spoilt.shape == clean.shape
    keep = [0, 2, 3]
    assert torch.equal(spoilt[keep], clean[keep])


def test_wrong_names_and_lengths_are_told(analytic: Analytic) -> None:
    motions = analytic("6pendulum", _uniform)
    model = build("hold", motions.graph, Statistics.of(motions))
    with pytest.raises(UnknownName, match="no model is called 'gnn'"):
        load_model("gnn")
    with pytest.raises(InputError, match="steps: got 15, allowed is 1 to 14"):
        rollout(model, motions, steps=15)


class _OneForAll(Hold):
    """Model that gives one change for all particles: sums would spread it."""

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        return super().predict(history, inputs)[:, :1]


def test_a_change_for_one_particle_is_not_that_of_all(analytic: Analytic) -> None:
    motions = analytic("6pendulum", _uniform)
    model = _OneForAll(motions.graph, Statistics.of(motions), None)
    with pytest.raises(ValueError, match=r"predict gave the shape \(4, 1, 3\), needed is \(4, 6"):
        rollout(model, motions)


class _Double(Hold):
    """Model that predicts in a higher precision than that of its inputs."""

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        return super().predict(history, inputs).double()


def test_the_precision_of_a_change_does_not_become_that_of_the_state(analytic: Analytic) -> None:
    motions = analytic("6pendulum", _uniform)
    sample = motions.take(torch.arange(4))
    model = _Double(motions.graph, Statistics.of(motions), None)
    assert model.advance(sample.start.history.float(), sample.inputs.at(0)).dtype == torch.float32
