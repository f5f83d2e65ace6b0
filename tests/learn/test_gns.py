"""GNS is what its paper says, and has the symmetries it should have and no more."""

import copy
import dataclasses
import itertools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.gns import GNS, GNSSettings, InteractionLayer, random_walk
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import build, rollout
from mbds_xsim.learn.statistics import Moments, Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Motions, Sample, Start
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene

SMALL = GNSSettings(width=16, steps=3)


def _statistics(channels: int = 2) -> Statistics:
    moments = Moments(torch.full((3,), 0.01).double(), torch.full((3,), 0.05).double())
    return Statistics(moments, moments, moments, torch.ones(channels).double())


def _gns(graph: Graph, settings: GNSSettings = SMALL) -> GNS:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return GNS(graph, _statistics(), settings)


def _history(graph: Graph, batch: int = 2) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    rest = graph.reference[: graph.particle_count].float()
    steps = torch.randn(batch, HISTORY, graph.particle_count, 3, generator=generator)
    return rest + (0.02 * steps * graph.moving).cumsum(1)


def _inputs(graph: Graph, batch: int = 2) -> KnownInputs:
    generator = torch.Generator().manual_seed(3)
    hinges = len(graph.mechanism.hinges)
    return KnownInputs(
        torch.randn(batch, graph.body_count, 3, generator=generator),
        torch.randn(batch, hinges, generator=generator),
    )


@pytest.mark.parametrize("name", PAPER_SCENES)
def test_every_scene_gives_finite_predictions_and_gradients(name: str) -> None:
    graph = Graph.of(load_scene(name))
    model, history = _gns(graph), _history(graph)
    inputs = _inputs(graph)
    steps = KnownInputs(inputs.force[:, None], inputs.torque[:, None])
    sample = Sample(Start(history, history[:, -1]), steps, history[:, -1:], history[:, -1:])
    loss = model.loss(sample, torch.Generator().manual_seed(0))
    torch.autograd.backward(loss)
    assert model.predict(history, inputs).shape == (2, graph.particle_count, 3)
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert len(gradients) > 10
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


@pytest.mark.parametrize("name", ["6pendulum", "particlecar", "2ladder"])
def test_numbering_of_particles_does_not_matter(name: str) -> None:
    graph = Graph.of(load_scene(name))
    count = graph.particle_count
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    nodes = torch.cat([order, torch.arange(count, graph.node_count)])
    place = nodes.argsort()
    other = dataclasses.replace(
        graph,
        body=graph.body[nodes],
        mass=graph.mass[nodes],
        reference=graph.reference[nodes],
        senders=place[graph.senders].flip(0),
        receivers=place[graph.receivers].flip(0),
    )
    model, history, inputs = _gns(graph), _history(graph), _inputs(graph)
    before = model.predict(history, inputs)
    after = _gns(other).predict(history[:, :, order], inputs)
    torch.testing.assert_close(after, before[:, order], rtol=1e-4, atol=1e-6)


def test_places_do_not_matter_but_heights_over_a_ground_do() -> None:
    shift = torch.tensor([3.0, -2.0, 0.0])
    graph = Graph.of(load_scene("simplecubli"))
    model, history, inputs = _gns(graph), _history(graph), _inputs(graph)
    low = history - torch.tensor([0.0, 0.0, 0.6])
    moved = model.predict(low + shift, inputs)
    torch.testing.assert_close(moved, model.predict(low, inputs), rtol=1e-3, atol=2e-5)
    lifted = model.predict(low + torch.tensor([0.0, 0.0, 0.05]), inputs)
    assert (lifted - moved).abs().max() > 1e-4


def test_it_does_not_turn_with_the_frame() -> None:
    graph = Graph.of(load_scene("5pendulum"))
    model, history, inputs = _gns(graph), _history(graph), _inputs(graph)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned_inputs = KnownInputs(inputs.force @ quarter.T, inputs.torque)
    turned = model.predict(history @ quarter.T, turned_inputs)
    expected = model.predict(history, inputs) @ quarter.T
    assert (turned - expected).abs().max() > 0.1 * expected.std()


def test_an_interaction_is_that_of_the_paper() -> None:
    torch.manual_seed(0)
    width, senders, receivers = 8, torch.tensor([0, 1, 2, 2]), torch.tensor([1, 0, 1, 0])
    layer = InteractionLayer(width, 2)
    nodes, edges = torch.randn(3, 5, width), torch.randn(4, 5, width)
    new_nodes, new_edges = layer(nodes, edges, senders, receivers)
    for batch in range(5):
        received = torch.zeros(3, width)
        for k, (j, i) in enumerate(zip(senders.tolist(), receivers.tolist(), strict=True)):
            joined = torch.cat([nodes[i, batch], nodes[j, batch], edges[k, batch]])
            message = layer.message(layer.ends(joined))
            received[i] += message
            torch.testing.assert_close(new_edges[k, batch], edges[k, batch] + message)
        for i in range(3):
            change = layer.update(torch.cat([received[i], nodes[i, batch]]))
            torch.testing.assert_close(new_nodes[i, batch], nodes[i, batch] + change)


def test_every_interaction_updates_the_edges_with_weights_of_its_own() -> None:
    graph = Graph.of(load_scene("6pendulum"))
    model = _gns(graph)
    updates: list[tuple[Tensor, Tensor]] = []
    for layer in model.interactions:
        layer.register_forward_hook(lambda _, old, new: updates.append((old[1], new[1])))
    model.predict(_history(graph), _inputs(graph))
    assert len(updates) == SMALL.steps
    for before, after in updates:
        assert (after - before).abs().max() > 0.1
    for (_, after), (before, _) in itertools.pairwise(updates):
        assert after is before
    first, second = (layer.state_dict() for layer in list(model.interactions)[:2])
    assert all(not torch.equal(first[k], second[k]) for k in first if "ends" in k)


def test_noise_is_a_random_walk_of_the_velocities() -> None:
    noise = random_walk(torch.zeros(4000, HISTORY, 3, 3), 0.3, torch.Generator().manual_seed(0))
    assert noise[:, 0].abs().max() == 0
    velocity = noise.diff(dim=1)
    for step in range(HISTORY - 1):
        expected = 0.3 * ((step + 1) / (HISTORY - 1)) ** 0.5
        assert velocity[:, step].std().item() == pytest.approx(expected, rel=0.02)


def test_the_target_corrects_the_noise_of_the_velocity_exactly() -> None:
    graph = Graph.of(load_scene("6pendulum"))
    model = _gns(graph)
    history = _history(graph).double()
    after = history[:, -1] + 0.1
    noise = random_walk(history, 0.05, torch.Generator().manual_seed(0))
    normalised = model.target(history, noise, after)
    acceleration = normalised * model.acceleration_std + model.acceleration_mean
    noisy = history + noise
    velocity = noisy[:, -1] - noisy[:, -2] + acceleration
    torch.testing.assert_close(velocity, after - history[:, -1], rtol=0, atol=1e-7)
    # The noise of the last position stays.
    reached = noisy[:, -1] + velocity
    torch.testing.assert_close(reached - after, noise[:, -1], rtol=0, atol=1e-7)


def test_normalisation_counts_the_noise_in() -> None:
    graph = Graph.of(load_scene("6pendulum"))
    model = _gns(graph, GNSSettings(width=16, steps=1, noise=2.0))
    assert model.noise_std == pytest.approx(0.1)
    expected = torch.full((3,), (0.05**2 + 0.1**2) ** 0.5)
    torch.testing.assert_close(model.acceleration_std, expected)
    torch.testing.assert_close(model.displacement_std, expected)


def test_in_the_plane_nothing_leaves_it(data: Callable[..., Dataset]) -> None:
    motions = Motions.of(data("balldrop"), "test")
    model = build("gns", motions.graph, _statistics(), track="lite")
    predicted = rollout(model, motions, steps=5)
    assert torch.equal(predicted[..., 1], motions.position[:, HISTORY : HISTORY + 5, :, 1])


def test_a_seed_makes_the_same_model_and_another_another() -> None:
    graph = Graph.of(load_scene("2pendulum"))
    first, same, other = (
        build("gns", graph, _statistics(), track="lite", seed=seed).state_dict()
        for seed in (0, 0, 1)
    )
    assert all(torch.equal(value, same[key]) for key, value in first.items())
    assert not torch.equal(first["decoder.0.weight"], other["decoder.0.weight"])


def test_paper_size_is_that_of_the_paper() -> None:
    graph = Graph.of(load_scene("6pendulum"))
    native = build("gns", graph, _statistics(), track="native")
    # 10 interactions of 128: 3 linear layers and a normalisation each, on edges and on nodes.
    each = 3 * 128**2 + 2 * 128**2 + 2 * 128**2 + 2 * 128**2 + 6 * 128 + 4 * 128
    assert isinstance(native, GNS)
    count = sum(p.numel() for p in native.interactions.parameters())
    assert count == 10 * each


def test_one_window_can_be_learned_by_heart() -> None:
    graph = Graph.of(load_scene("6pendulum"))
    model, history, inputs = _gns(graph), _history(graph, 4), _inputs(graph, 4)
    wanted = torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(5))
    before = copy.deepcopy(model)
    adam = torch.optim.Adam(model.parameters(), lr=5e-3)
    for _ in range(150):
        adam.zero_grad()
        loss = ((model(history, inputs) - wanted) ** 2).mean()
        torch.autograd.backward(loss)
        adam.step()
    started = ((before(history, inputs) - wanted) ** 2).mean()
    assert loss < 0.02 * started
