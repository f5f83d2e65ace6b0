"""Windows hold the file's values; inputs are those that a model may know."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.statistics import Channels, Moments, Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Motions
from mbds_xsim.simulate.registry import load_scene

Data = Callable[..., Dataset]


def test_windows_are_the_published_frames(data: Data) -> None:
    file = data("6pendulum")
    motions = Motions.of(file, "train", bodies=True)
    rows = file.rows_of("train")
    numbers = torch.tensor([0, 7, motions.window_count(2) - 1])
    sample = motions.take(numbers, horizon=2)
    each = motions.frame_count - HISTORY - 1
    for k, number in enumerate(numbers.tolist()):
        whole = file.position[int(rows[number // each])]
        first = number % each
        window = whole[first : first + HISTORY + 2]
        np.testing.assert_array_equal(sample.start.history[k].numpy(), window[:HISTORY])
        np.testing.assert_array_equal(sample.position[k].numpy(), window[HISTORY:])
        velocity = file.velocity[int(rows[number // each])][first + HISTORY - 1]
        np.testing.assert_array_equal(sample.start.velocity[k].numpy(), velocity)
        assert sample.start.body is not None
        body = file["body/position"][int(rows[number // each])][first : first + HISTORY]
        np.testing.assert_array_equal(sample.start.body[k, ..., :3].numpy(), body)


def test_inputs_are_those_of_the_frame_to_come(data: Data) -> None:
    file = data("2ladder")
    motions = Motions.of(file, "train")
    sample = motions.sample(torch.tensor([3]), torch.tensor([HISTORY - 1]), 2)
    known = file["input/known_force"][int(file.rows_of("train")[3])]
    wanted = known[HISTORY - 1 : HISTORY + 1].astype(np.float32)
    np.testing.assert_array_equal(sample.inputs.force[0].numpy(), wanted)


def test_noise_is_never_an_input(data: Data) -> None:
    calm, windy = data("6pendulum"), data("2ladder")
    assert np.abs(calm["input/force"][0]).max() > 0
    assert Motions.of(calm, "train").inputs.force.abs().max() == 0
    inputs = Motions.of(windy, "train").inputs.force[0].numpy()
    row = int(windy.rows_of("train")[0])
    all_of_it, known = windy["input/force"][row], windy["input/known_force"][row]
    np.testing.assert_allclose(inputs, known, rtol=1e-6)
    assert np.abs(all_of_it - inputs).max() > 0.01


def test_data_without_the_known_forces_of_their_scene_are_refused(
    data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.learn.window.has_known_forces", lambda _: True)
    with pytest.raises(InputError, match="lacks input/known_force, which earlier"):
        Motions.of(data("6pendulum"), "train")


def test_statistics_come_from_the_training_part_only(data: Data) -> None:
    file = data("6pendulum")
    statistics = Statistics.of(Motions.of(file, "train"))
    rows = file.rows_of("train")
    published = np.stack([file.position[int(row)] for row in rows]).astype(np.float64)
    steps = np.diff(published, axis=1)
    np.testing.assert_allclose(statistics.displacement.mean, steps.mean((0, 1, 2)), rtol=1e-9)
    np.testing.assert_allclose(statistics.displacement.std, steps.std((0, 1, 2)), rtol=1e-9)
    second = np.diff(steps, axis=1)
    np.testing.assert_allclose(statistics.acceleration.std, second.std((0, 1, 2)), rtol=1e-9)
    for split in ("validation", "test"):
        with pytest.raises(InputError, match="allowed is 'train'"):
            Statistics.of(Motions.of(file, split))


def test_isotropic_statistics_have_one_deviation_and_only_the_mean_along_gravity(
    data: Data,
) -> None:
    motions = Motions.of(data("balldrop"), "train")
    plain = Statistics.of(motions)
    even = plain.isotropic(motions.graph.gravity)
    assert even.displacement.mean[:2].abs().max() == 0
    assert even.displacement.mean[2] == plain.displacement.mean[2]
    assert (even.displacement.std == even.displacement.std[0]).all()
    low, high = plain.displacement.std[[0, 2]].sort().values
    assert low <= even.displacement.std[0] <= 1.01 * torch.hypot(high, plain.displacement.mean[0])


def test_an_axis_that_does_not_vary_is_no_part_of_the_spread() -> None:
    """A planar motion in space has such an axis; its deviation is stored as 1."""
    moments = Moments(torch.zeros(3).double(), torch.tensor([0.03, 1.0, 0.04]).double())
    everywhere, across = torch.ones(3).bool(), torch.tensor([False, True, False])
    assert moments.spread(everywhere) == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2))
    assert moments.spread(torch.tensor([True, False, False])) == pytest.approx(0.03)
    assert moments.spread(across) == 1.0


def test_statistics_are_read_back_as_stored(data: Data) -> None:
    statistics = Statistics.of(Motions.of(data("6pendulum"), "train"))
    again = Statistics.from_state(statistics.to_state())
    assert all(
        torch.equal(value, again.to_state()[key]) for key, value in statistics.to_state().items()
    )


@pytest.mark.parametrize("name", ["particlecar", "simplecubli"])
def test_axes_of_hinges_follow_from_the_particles(name: str) -> None:
    graph = Graph.of(load_scene(name))
    mechanism = graph.mechanism
    rng = np.random.default_rng(0)
    turn = rng.standard_normal((5, graph.body_count, 4))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    parents = [hinge.parent for hinge in mechanism.hinges]
    place = rng.standard_normal((5, graph.body_count, 3))
    particles = mechanism.particle_positions(place, mechanism.body_orientation(turn))
    axes = Channels(graph).axes(torch.from_numpy(particles).float())
    expected = np.stack(
        [
            rotation.rotate(turn[:, parent], hinge.axis)
            for parent, hinge in zip(parents, mechanism.hinges, strict=True)
        ],
        axis=1,
    )
    np.testing.assert_allclose(axes.numpy(), expected, atol=2e-6)


def test_torques_balance_and_forces_add_up_to_those_of_the_bodies() -> None:
    graph = Graph.of(load_scene("particlecar"))
    particles = graph.reference[None].float()
    force = torch.randn(1, graph.body_count, 3)
    torque = torch.tensor([[1.0, -2.0, 0.5, 0.25]])
    vectors = Channels(graph)(particles, KnownInputs(force, torque))[0]
    total = torch.zeros(graph.body_count, 3).index_add_(0, graph.body, vectors[:, 0])
    torch.testing.assert_close(total, force[0])
    by_body = torch.stack([vectors[graph.body == k, 1][0] for k in range(graph.body_count)])
    torch.testing.assert_close(by_body.sum(0), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(by_body[1:, 1], torque[0])
