"""LGNN and HGNN as models: starts, frames, learning, refusals."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch

from benchmarks.energy_rollouts import errors, from_places
from mbds_xsim.base import rotation
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.dataset.points import Points
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.energy_models import EnergyModel, Hamiltonian, Lagrangian
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import build
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Motions, Sample, Start
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import load_scene
from tests.learn.models import squared_error

from .energies import TrueEnergy, drawn_states
from .mechanisms import scene_of

DYNAMICS = {"lgnn": Lagrangian, "hgnn": Hamiltonian}

Data = Callable[..., Dataset]


def motions_of(data: Data, split: str) -> Motions:
    return Motions.of(data("6pendulum"), split, bodies=True, dtype=torch.float64)


def untrained(name: str, motions: Motions) -> EnergyModel:
    model = build(name, motions.graph, Statistics.of(motions), track="lite")
    assert isinstance(model, EnergyModel)
    return model


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_the_true_energy_predicts_frames(data: Data, name: str) -> None:
    """The energy is far closer than any formula; the rest is the engine's error and the noise."""
    motions = motions_of(data, "train")
    model = untrained(name, motions)
    model.register_module("dynamics", DYNAMICS[name](TrueEnergy(model.mechanics)))
    error = squared_error(model, motions, steps=10)[:, -1].mean()
    formula = build("constant_acceleration", motions.graph, Statistics.of(motions)).double()
    trivial = squared_error(formula, motions, steps=10)[:, -1].mean()
    assert error < 1e-2 * trivial


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_a_start_is_what_was_published(data: Data, name: str) -> None:
    motions = motions_of(data, "train")
    model = untrained(name, motions)
    start = motions.take(torch.arange(0, 20, 5)).start
    state = model.begin(start)
    assert (model.positions(state) - start.history[:, -1]).abs().max() < 1e-6
    assert (model.velocities(state) - start.velocity).abs().max() < 1e-5
    assert model.mechanics.residual(state[:, 0]).abs().max() < 1e-12


@pytest.mark.parametrize("scene", ["workbench", "linked", "every_joint"])
def test_a_start_is_where_the_bodies_are(scene: str) -> None:
    """Frames of bodies may be turned at the reference pose, and nodes may be off centres."""
    graph = Graph.of(scene_of(scene))
    model = build("lgnn", graph, Statistics.of_nothing(), track="lite")
    assert isinstance(model, EnergyModel)
    batch = draw_batch(graph.scene, range(3), noise=False)
    rows = ("position", "orientation", "velocity", "angular_velocity")
    body = torch.cat([torch.as_tensor(getattr(batch, name)) for name in rows], dim=-1)
    history = torch.zeros(3, HISTORY, graph.particle_count, 3).double()
    state = model.begin(Start(history, history[:, 0], body[:, None]))
    q, v = drawn_states(model.mechanics, 3)
    assert torch.allclose(state[:, 0], q, atol=1e-9)
    assert torch.allclose(state[:, 1], v, atol=1e-9)
    assert scene == "every_joint" or (v != 0.0).any()
    published = Points.of(graph.scene)
    at = batch.position[:, published.body] + rotation.rotate(
        published.mechanism.native_rotation(batch.orientation)[:, published.body], published.offset
    )
    assert torch.allclose(model.positions(state), torch.as_tensor(at), atol=1e-9)


def test_violent_windows_have_no_say_and_slow_ones_as_much_as_fast_ones(data: Data) -> None:
    """A window's weight is the slope of its part of the loss by the logarithm of its error."""
    motions = motions_of(data, "train")
    model = untrained("lgnn", motions)
    sample = motions.take(torch.tensor([0, 11, 40]))
    floor = EnergyModel.tracks["lite"].floor
    assert floor is not None

    def loss(size: float, floor: float | None) -> float:
        """Return the loss of windows that all miss by `size` second differences."""
        model.floor = floor
        off = size * float(model.spread)
        state = model.advance(model.begin(sample.start), sample.inputs.at(0))
        moved, fast = model.positions(state), model.velocities(state)
        missed = dataclasses.replace(
            sample, position=(moved + off)[:, None], velocity=fast[:, None]
        )
        return float(model.loss(missed, torch.Generator()))

    def weight(error: float) -> float:
        near = [loss(math.sqrt(error * factor), floor) for factor in (0.99, 1.01)]
        return (near[1] - near[0]) / math.log(1.01 / 0.99)

    with torch.no_grad():
        assert loss(0.3, None) == pytest.approx(0.09)
        assert weight(0.1) == pytest.approx(weight(0.01), rel=0.15)
        assert weight(1e-3) == pytest.approx(weight(0.01), rel=0.15)
        assert weight(1e5) < 1e-4 * weight(0.01)
        assert weight(1e-2 * floor) < 0.02 * weight(0.01)


@pytest.mark.parametrize("seed", range(4))
def test_an_untrained_drag_leaves_the_integrator_stable(data: Data, seed: int) -> None:
    """At the speeds of a whip: Runge-Kutta's steps are stable to 2.78 time constants a frame."""
    motions = motions_of(data, "train")
    model = build("lgnn", motions.graph, Statistics.of(motions), track="lite", seed=seed)
    assert isinstance(model, EnergyModel)
    assert model.drag is not None
    fast = torch.randn(64, model.mechanics.free, 3, dtype=torch.float64)
    fast = fast * torch.logspace(0, 2.3, 64, dtype=torch.float64)[:, None, None]
    with torch.no_grad():
        braked = model.mechanics.mass_inverse @ model.drag(fast)
    share = braked.norm(dim=(1, 2)) / fast.norm(dim=(1, 2)) * motions.graph.frame_s
    assert share.max() < 2.78


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_it_learns(data: Data, name: str) -> None:
    motions = motions_of(data, "train")
    model = untrained(name, motions)
    sample = motions.take(torch.arange(0, motions.window_count(), 11))
    generator = torch.Generator().manual_seed(0)
    before = float(model.loss(sample, generator).detach())
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(25):
        optimiser.zero_grad()
        model.loss(motions.draw(16, generator), generator).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    # The loss is one of logarithms: the windows' errors have halved.
    assert float(model.loss(sample, generator).detach()) < before - math.log(2.0)


def _untrained_and_sample(data: Data, name: str) -> tuple[EnergyModel, Sample]:
    motions = motions_of(data, "train")
    return untrained(name, motions), motions.take(torch.arange(3))


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_settling_closes_the_joints_frame_by_frame(data: Data, name: str) -> None:
    model, sample = _untrained_and_sample(data, name)
    with torch.no_grad():
        state = model.advance(model.begin(sample.start), sample.inputs.at(0))
    drift = model.mechanics.residual(state[:, 0]).abs().max()
    q, v = model.mechanics.project(state[:, 0], model.dynamics.velocity(state[:, 1]))
    settled = torch.stack([q, model.dynamics.conjugate(v)], dim=1)
    assert model.mechanics.residual(settled[:, 0]).abs().max() < 1e-13 < drift
    assert (settled - state).abs().max() < 1e2 * drift


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_a_row_that_has_no_numbers_leaves_the_others(data: Data, name: str) -> None:
    model, sample = _untrained_and_sample(data, name)
    with torch.no_grad():
        state = model.begin(sample.start)
        alone = model.advance(state, sample.inputs.at(0))
        state[1] = torch.nan
        after = model.advance(state, sample.inputs.at(0))
    assert after[1].isnan().any()
    assert torch.equal(after[[0, 2]], alone[[0, 2]])


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_starts_from_places_have_the_velocities_of_the_motion(data: Data, name: str) -> None:
    """Such starts do not use the velocities of the data, which are falsified here."""
    motions = motions_of(data, "train")
    model = untrained(name, motions)
    rows = torch.arange(len(motions))
    exact = model.begin(motions.sample(rows, torch.full_like(rows, HISTORY - 1), 1).start)
    assert motions.body is not None
    motions.body[..., 7:] = 1e3
    estimated = from_places(model, motions)
    speed = model.velocities(exact).norm(dim=-1).amax(1)
    off = (model.velocities(estimated) - model.velocities(exact)).norm(dim=-1).amax(1)
    assert float((off / speed).median()) < 0.01
    assert (model.positions(estimated) - model.positions(exact)).abs().max() < 1e-9


def test_rollouts_of_the_benchmark_start_where_they_are_told_to(
    data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    motions = motions_of(data, "train")
    monkeypatch.setattr("benchmarks.energy_rollouts.FRAMES", (2, motions.frame_count - HISTORY))
    model = untrained("hgnn", motions)
    rows = torch.arange(len(motions))
    start = motions.sample(rows, torch.full_like(rows, HISTORY - 1), 1).start
    with torch.no_grad():
        given = model.begin(start)
    assert errors(model, motions) == errors(model, motions, given)
    assert errors(model, motions, given.roll(1, dims=0)) != errors(model, motions)


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_a_graph_without_edges_falls_freely(data: Data, name: str) -> None:
    scene = Scene("thrown", load_scene("ballscroll").bodies, 1.0)
    graph = Graph.of(scene)
    assert (graph.particle_count, len(graph.senders)) == (1, 0)
    model = build(name, graph, Statistics.of(motions_of(data, "train")), track="lite")
    assert isinstance(model, EnergyModel)
    body = torch.zeros(2, 1, 13, dtype=torch.float64)
    body[..., 3], body[..., 7:10] = 1.0, torch.tensor([1.0, -2.0, 3.0])
    body[..., 10:] = torch.tensor([4.0, 5.0, 6.0])
    still = torch.zeros(2, 1, 3, dtype=torch.float64)
    state = model.begin(Start(still[:, None].expand(-1, HISTORY, -1, -1), still, body[:, None]))
    inputs = KnownInputs(still, torch.zeros(2, 0, dtype=torch.float64))
    with torch.no_grad():
        assert model.positions(model.advance(state, inputs)).isfinite().all()
        model.register_module("dynamics", DYNAMICS[name](TrueEnergy(model.mechanics)))
        moved = model.positions(model.advance(state, inputs)) - model.positions(state)
    time = graph.frame_s
    fallen = body[..., 7:10] * time + 0.5 * torch.tensor(scene.gravity) * time**2
    assert (moved - fallen).abs().max() < 1e-9


@pytest.mark.parametrize("name", list(DYNAMICS))
def test_contact_is_refused(data: Data, name: str) -> None:
    statistics = Statistics.of(motions_of(data, "train"))
    with pytest.raises(Unsupported, match=r"balldrop.*contact"):
        build(name, Graph.of(load_scene("balldrop")), statistics)
