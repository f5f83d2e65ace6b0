"""SGNN: symmetries that it has, symmetries that it must not have, and learning."""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass

import msgspec
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.sgnn import SGNN, SGNNSettings, nearest_rigid
from mbds_xsim.learn.sgnn_network import (
    LEAST_NORM,
    PARTICLE,
    READ,
    Edges,
    Hierarchy,
    Network,
    Passing,
    SubequivariantMap,
    invariants,
)
from mbds_xsim.learn.statistics import Moments, Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Sample, Start
from mbds_xsim.simulate.registry import load_scene

torch.set_num_threads(1)
SCENES = ("6pendulum", "3ladder", "ballscroll", "balldrop", "particlecar", "simplecubli", "bricard")
TINY = {
    "displacement": SGNNSettings(hidden=16),
    "change": SGNNSettings(hidden=16, target="change", unit="spacing"),
}
SIZE, STEP = 0.5, 0.05


@dataclass
class Case:
    """A model and something to predict from."""

    model: SGNN
    history: Tensor
    inputs: KnownInputs

    def predict(self) -> Tensor:
        with torch.no_grad():
            return self.model.predict(self.history, self.inputs)

    def moved(self, matrix: Tensor, along: Tensor | None = None) -> Case:
        """Turn, mirror or shift everything but gravity."""
        graph, shift = self.model.graph, torch.zeros(3) if along is None else along
        anchors = graph.reference @ matrix.to(graph.reference).T + shift
        reference = torch.where(graph.static[:, None], anchors, graph.reference)
        model = twin(self.model, dataclasses.replace(graph, reference=reference))
        torque = self.inputs.torque
        return Case(
            model,
            self.history @ matrix.T + shift.to(matrix),
            KnownInputs(self.inputs.force @ matrix.T, torque),
        )


def twin(model: SGNN, graph: Graph) -> SGNN:
    """Return another model with the same weights."""
    other = SGNN(graph, statistics(), model.settings).to(model.up.dtype)
    other.load_state_dict(model.state_dict())
    return other


def statistics() -> Statistics:
    """Return plausible statistics, with means that only gravity may keep."""
    mean = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    spread = torch.tensor([1.0, 0.8, 1.3], dtype=torch.float64)
    return Statistics(
        position=Moments(SIZE * mean, SIZE * spread),
        displacement=Moments(STEP * mean, STEP * spread),
        acceleration=Moments(STEP**2 * mean, STEP**2 * spread),
        channels=torch.ones(2, dtype=torch.float64),
    )


def case_of(graph: Graph, settings: SGNNSettings, dtype: torch.dtype = torch.float64) -> Case:
    torch.manual_seed(1)
    model = SGNN(graph, statistics(), settings).to(dtype)
    particles = graph.reference[: graph.particle_count].to(dtype)
    shape = (3, HISTORY, *particles.shape)
    history = particles + 0.1 * torch.randn(shape[0], 1, *shape[2:], dtype=dtype)
    history = history + STEP * torch.randn(shape, dtype=dtype).cumsum(1)
    force = torch.randn(3, graph.body_count, 3, dtype=dtype)
    torque = torch.randn(3, len(graph.mechanism.hinges), dtype=dtype)
    return Case(model, history, KnownInputs(force, torque))


@pytest.fixture(scope="module", params=SCENES)
def graph(request: pytest.FixtureRequest) -> Graph:
    return Graph.of(load_scene(request.param))


@pytest.fixture(params=TINY)
def settings(request: pytest.FixtureRequest) -> SGNNSettings:
    return TINY[request.param]


def turn(axis: str, angle: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(Rotation.from_euler(axis, angle).as_matrix(), dtype=dtype)


def unlike(one: Tensor, other: Tensor) -> float:
    """Return the largest difference relative to the largest entry."""
    return float((one - other).abs().max() / other.abs().max())


@pytest.mark.parametrize(("dtype", "most"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_commutes_with_rotation_about_gravity(
    graph: Graph, settings: SGNNSettings, dtype: torch.dtype, most: float
) -> None:
    case, matrix = case_of(graph, settings, dtype), turn("z", 1.1, dtype)
    assert unlike(case.moved(matrix).predict(), case.predict() @ matrix.T) < most


def test_knows_where_down_is(graph: Graph, settings: SGNNSettings) -> None:
    case, matrix = case_of(graph, settings), turn("x", 0.5)
    assert unlike(case.moved(matrix).predict(), case.predict() @ matrix.T) > 1e-3


@pytest.mark.parametrize(("dtype", "most"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_commutes_with_mirrors_that_hold_gravity(
    graph: Graph, settings: SGNNSettings, dtype: torch.dtype, most: float
) -> None:
    case = case_of(graph, settings, dtype)
    case.inputs.torque.zero_()  # an axis found from particles alone cannot tell the sense
    for matrix in (mirror(dtype), mirror(dtype) @ turn("z", 2.3, dtype)):
        assert unlike(case.moved(matrix).predict(), case.predict() @ matrix.T) < most


def mirror(dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=dtype))


def test_translation_changes_nothing(graph: Graph, settings: SGNNSettings) -> None:
    along = torch.tensor([3.0, -2.0, 0.0 if graph.ground else 1.0], dtype=torch.float64)
    case = case_of(graph, settings)
    moved = case.moved(torch.eye(3, dtype=torch.float64), along)
    assert unlike(moved.predict(), case.predict()) < 1e-6  # averages have weights like 1/19


def test_ground_is_felt() -> None:
    case = case_of(Graph.of(load_scene("balldrop")), TINY["displacement"])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    moved = case.moved(torch.eye(3, dtype=torch.float64), up)
    assert unlike(moved.predict(), case.predict()) > 1e-3


@pytest.mark.parametrize("scene", ["simplecubli", "particlecar"])
def test_torque_is_felt_and_its_sense(scene: str) -> None:
    case = case_of(Graph.of(load_scene(scene)), TINY["displacement"])
    pushed = case.predict()
    case.inputs.torque.neg_()
    pulled = case.predict()
    case.inputs.torque.zero_()
    free = case.predict()
    assert unlike(pushed, free) > 1e-3
    assert unlike(pushed, pulled) > 1e-3


def test_numbering_changes_nothing(graph: Graph, settings: SGNNSettings) -> None:
    """Particles, bodies and edges are renumbered, below the inputs."""
    network = case_of(graph, settings).model.network
    order, edges = torch.randperm(graph.node_count), torch.randperm(len(graph.senders))
    number = torch.argsort(order)
    alone = graph.body_count + torch.arange(graph.node_count)
    body = torch.where(graph.static, alone, torch.randperm(graph.body_count)[graph.body])
    ends = graph.senders[edges], graph.receivers[edges]
    hierarchy = Hierarchy(number[ends[0]], number[ends[1]], graph.inner[edges], body[order])
    other = copy.deepcopy(network)
    other.hierarchy = hierarchy.double()
    given = nodes_of(network, graph.node_count)
    shuffled = [values[:, order] for values in given]
    with torch.no_grad():
        assert unlike(other(*shuffled), network(*given)[:, order]) < 1e-10


def nodes_of(network: Network, count: int) -> list[Tensor]:
    """Position, velocity, externals and scalars of some nodes."""
    externals = network.within.update.outputs - (READ + PARTICLE + 1)
    shapes = (3,), (3,), (externals, 3), (network.embedding.in_features,)
    return [torch.randn(2, count, *shape, dtype=torch.float64) for shape in shapes]


def test_runs_without_edges_and_with_one_object() -> None:
    graph = Graph.of(load_scene("ballscroll"))
    assert (len(graph.senders), graph.node_count) == (0, 1)
    assert case_of(graph, TINY["change"]).predict().isfinite().all()


def test_everything_at_rest_has_finite_gradients(graph: Graph, settings: SGNNSettings) -> None:
    case = case_of(graph, settings, torch.float32)
    still = case.history[:, :1].expand(-1, HISTORY, -1, -1)
    none = KnownInputs(0 * case.inputs.force, 0 * case.inputs.torque)
    loss = case.model.normalised(still, none).square().sum()
    grads = torch.autograd.grad(loss, list(case.model.parameters()), allow_unused=True)
    assert any(grad is not None for grad in grads)
    assert all(grad.isfinite().all() for grad in grads if grad is not None)


def test_gradient_reaches_every_parameter() -> None:
    model = (case := case_of(Graph.of(load_scene("particlecar")), TINY["displacement"])).model
    weights = dict(model.named_parameters())
    loss = model.loss(sample_of(case), torch.Generator())
    grads = torch.autograd.grad(loss, list(weights.values()))
    assert not [name for name, grad in zip(weights, grads, strict=True) if not grad.any()]


def sample_of(case: Case) -> Sample:
    """Return a random sample of one frame to come."""
    frames = case.history[:, -1:] + STEP * torch.randn_like(case.history[:, -1:])
    velocity = torch.zeros_like(frames)
    inputs = KnownInputs(case.inputs.force[:, None], case.inputs.torque[:, None])
    return Sample(Start(case.history, velocity[:, 0]), inputs, frames, velocity)


def test_target_of_noisy_history_restores_the_true_velocity(settings: SGNNSettings) -> None:
    noisy = msgspec.structs.replace(settings, noise=0.3)
    case = case_of(Graph.of(load_scene("6pendulum")), noisy)
    sample = sample_of(case)
    history, after = case.model.noisy(sample, torch.Generator().manual_seed(3))
    wanted = case.model.output.restore(case.model.target(history, after))
    if settings.target == "change":
        wanted = wanted + history[:, -1] - history[:, -2]
    assert unlike(history, case.history) > 1e-3
    moves = case.model.graph.moving
    assert unlike(wanted, sample.position[:, 0] - case.history[:, -1]) < 1e-6
    assert not (history - case.history)[..., ~moves].any()


def test_projection_restores_rigid_shapes_exactly() -> None:
    generator = torch.Generator().manual_seed(5)
    owner = torch.tensor(
        [0, 1, 0, 2, 1, 0, 0, 2, 3, 3, 3, 2, 4]
    )  # a point is body 4, body 3 a line
    shape = torch.randn(20, len(owner), 3, dtype=torch.float64, generator=generator)
    shape[:, owner == 3] = torch.linspace(-1, 1, 3, dtype=torch.float64)[:, None]
    turns = torch.tensor(Rotation.random(100, rng=7).as_matrix()).reshape(20, 5, 3, 3)
    moved = (turns[:, owner] @ shape[..., None])[..., 0] + torch.randn(20, 5, 3)[:, owner]
    assert (nearest_rigid(shape, moved, owner) - moved).abs().max() < 1e-12
    bent = moved + 0.05 * torch.randn(moved.shape, dtype=torch.float64, generator=generator)
    straight = nearest_rigid(shape, bent, owner)
    same = owner[:, None] == owner
    assert (gaps(straight) - gaps(shape))[:, same].abs().max() < 1e-12
    assert (gaps(bent) - gaps(shape))[:, same].abs().max() > 0.01
    assert (straight - bent).square().sum() < (moved - bent).square().sum()


def gaps(points: Tensor) -> Tensor:
    return (points[:, :, None] - points[:, None]).norm(dim=-1)


def test_projection_never_mirrors() -> None:
    shape = torch.randn(50, 6, 3, dtype=torch.float64)
    owner = torch.zeros(6, dtype=torch.int64)
    projected = nearest_rigid(shape, shape @ mirror(), owner)
    assert (volume(projected) * volume(shape) > 0).all()


def volume(points: Tensor) -> Tensor:
    """Return the signed volume of the parallelepiped of the first four points."""
    return torch.det(points[:, 1:4] - points[:, :1])


def test_projection_passes_on_what_is_not_finite() -> None:
    owner = torch.tensor([0, 0, 0, 1, 1, 1])
    shape = torch.randn(2, 6, 3)
    predicted = shape.clone()
    predicted[0, 1] = torch.nan
    projected = nearest_rigid(shape, predicted, owner)
    assert projected[0].isnan().all()
    assert (projected[1] - shape[1]).abs().max() < 1e-5


def test_rigid_rollout_keeps_distances() -> None:
    settings = msgspec.structs.replace(TINY["displacement"], rigid=True)
    case = case_of(Graph.of(load_scene("simplecubli")), settings)
    now = case.history[:, -1]
    after = case.model.advance(case.history, case.inputs)[:, -1].detach()
    owner = case.model.graph.body
    same = owner[:, None] == owner
    assert (gaps(after) - gaps(now))[:, same].abs().max() < 1e-12
    assert (gaps(after) - gaps(now))[:, ~same].abs().max() > 1e-3


@pytest.mark.parametrize("size", [1.0, 0.1 * LEAST_NORM**0.5])
def test_the_slope_of_the_invariants_is_that_of_their_formula(size: float) -> None:
    torch.manual_seed(0)
    vectors = (size * torch.randn(4, 5, 3, dtype=torch.float64)).requires_grad_()
    products = (vectors @ vectors.mT).flatten(-2)
    formula = torch.nn.functional.normalize(products, dim=-1, eps=LEAST_NORM)
    assert torch.allclose(invariants(vectors), formula, rtol=1e-14)
    weights = torch.randn_like(formula)
    (expected,) = torch.autograd.grad((formula * weights).sum(), vectors)
    (slope,) = torch.autograd.grad((invariants(vectors) * weights).sum(), vectors)
    assert (slope - expected).abs().max() < 1e-12 * expected.abs().max()


def test_what_is_left_out_counts_as_zero() -> None:
    torch.manual_seed(4)
    layer = SubequivariantMap(5, [2, 3], outputs=2, hidden=8, layers=3).double()
    vectors, own = torch.randn(7, 3, 3).double(), torch.randn(7, 2).double()
    silent = torch.zeros(7, 2, 3).double(), torch.zeros(7, 3).double()
    whole = layer(torch.cat([vectors, silent[0]], dim=1), own, silent[1])
    for got, wanted in zip(layer(vectors, own), whole, strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-12, atol=1e-12)


def test_without_edges_a_node_hears_zeros() -> None:
    """The node must behave like one in a larger graph to which no edge leads."""
    torch.manual_seed(5)
    layer = Passing(2, edge_channels=1, edge_scalars=4, hidden=8, layers=2, steps=3).double()
    vectors, scalars = torch.randn(1, 3, 2, 3).double(), torch.randn(1, 3, 8).double()
    none = Edges(torch.empty(0, dtype=torch.int64), torch.empty(0, dtype=torch.int64), 3)
    one = Edges(torch.tensor([0]), torch.tensor([1]), 3)
    alone = layer(vectors, scalars, none, torch.empty(1, 0, 1, 3).double(), torch.empty(1, 0, 4))
    joined = layer(
        vectors,
        scalars,
        one.double(),
        torch.randn(1, 1, 1, 3).double(),
        torch.randn(1, 1, 4).double(),
    )
    for got, wanted in zip(alone, joined, strict=True):
        torch.testing.assert_close(got[:, [0, 2]], wanted[:, [0, 2]], rtol=1e-12, atol=1e-12)
        assert not torch.allclose(got[:, 1], wanted[:, 1])
