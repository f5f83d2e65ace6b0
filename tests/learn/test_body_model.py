"""Models of bodies: their starts, the lengths that they keep, and learned impacts."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch

from mbds_xsim.learn.body_model import BodyModel
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.impulse_models import ImpulseModel
from mbds_xsim.learn.model import build, load_model, rollout, track_of
from mbds_xsim.learn.nerd import NeRD
from mbds_xsim.learn.particles import RigidPairs
from mbds_xsim.learn.recipe import Profile
from mbds_xsim.learn.rigid import TWIST, Q, W
from mbds_xsim.learn.statistics import Moments, Statistics
from mbds_xsim.learn.train import train
from mbds_xsim.learn.window import HISTORY, KnownInputs, Motions
from mbds_xsim.scene.sampling_terms import HingeRate
from mbds_xsim.scene.scene import Body, DistanceLink, Inertia, Joint, Particle, Scene
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.models import motions_of

from .models import squared_error

_KNOWN = ["gns+", "sgnn+"]  # models that know smooth motion
_MODELS = [*_KNOWN, "hgnn+", "lgnn+", "nerd"]


@pytest.fixture(params=_MODELS)
def name(request: pytest.FixtureRequest) -> str:
    model: str = request.param
    return model


def _built(name: str, motions: Motions) -> BodyModel:
    model = build(name, motions.graph, Statistics.of(motions))
    assert isinstance(model, BodyModel)
    return model


def test_predictions_keep_all_lengths_whatever_a_network_adds(name: str) -> None:
    """Rods keep their lengths to a millionth of the chain's, with noise for corrections."""
    motions = motions_of(load_model(name), load_scene("3pendulum"))
    model = _built(name, motions)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.03 * torch.randn(parameter.shape).to(parameter))
    nodes = motions.graph.with_anchors(rollout(model, motions, steps=12))
    assert RigidPairs.of(motions.graph).gap(nodes).max() < 1e-6 * motions.graph.length


@pytest.mark.parametrize("name", _KNOWN)
def test_what_is_smooth_is_known_before_any_training(name: str) -> None:
    """Without a correction a whipping chain is at most 0.2 mm per metre off after ten frames."""
    motions = motions_of(load_model(name), load_scene("3pendulum"))
    model = _built(name, motions)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    off = squared_error(model, motions, steps=10)[:, -1].max().sqrt()
    assert off < 2e-4 * motions.graph.length


@pytest.mark.parametrize("scene", ["3pendulum", "simplecubli"])
def test_bodies_are_found_in_their_nodes(scene: str) -> None:
    """Poses and twists are recovered for one rod that never spins and for bodies of three axes."""
    motions = motions_of(load_model("lgnn+"), load_scene(scene))
    model = _built("lgnn+", motions)
    assert isinstance(model, ImpulseModel)
    state = model.begin(motions.sample(torch.arange(len(motions)), HISTORY - 1, 1).start)
    recovered = model.nodes.bodies(model.nodes.placed(state), state, 0.0)
    torch.testing.assert_close(recovered, state, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("followed", [0.0, 0.02])
def test_a_turn_is_found_whatever_of_it_the_spin_tells(followed: float) -> None:
    motions = motions_of(load_model("hgnn+"), load_scene("balldrop"))
    model = _built("hgnn+", motions)
    assert isinstance(model, ImpulseModel)
    state = model.begin(motions.sample(torch.arange(len(motions)), HISTORY - 1, 1).start)
    turn = torch.tensor([0.0, 0.0, 0.0, 0.7, -0.9, 0.4], dtype=torch.float64)
    turned = model.rigid.moved(state, turn.expand(len(state), 1, 6))
    recovered = model.nodes.bodies(model.nodes.placed(turned), state, followed)
    same = (recovered[..., Q] * turned[..., Q]).sum(-1).abs()  # q and -q are one turn
    torch.testing.assert_close(same, torch.ones_like(same), rtol=0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*_KNOWN, "lgnn+"])
def test_impacts_are_learned_in_seconds(name: str) -> None:
    """After a dropped disc has bounced, the error is less than a tenth of that of flight alone."""
    scene = load_scene("balldrop")
    motions = motions_of(load_model(name), scene, rows=60, frames=50)
    # Untrained gns+ is pure flight; untrained lgnn+ does not know gravity.
    flight = squared_error(_built("gns+", motions), motions)[:, -1].median()
    model = _built(name, motions)
    validation = motions[:8]
    validation = Motions(**{**vars(validation), "split": "validation"})
    recipe = model.tracks[track_of(name)].recipe
    train(model, motions, validation, recipe, Profile(150, 50, until_level=False))
    assert squared_error(model, motions)[:, -1].median() < 0.1 * flight


def test_a_track_is_the_one_asked_for_or_the_profiles_or_the_models_own() -> None:
    """A model with one track needs no track to be named."""
    assert track_of("gns+", None, "lite") == "native+"
    assert track_of("gns", None, "lite") == "lite"
    assert track_of("gns", "paper", "lite") == "paper"
    with pytest.raises(Exception, match="allowed for gns\\+ is native\\+"):
        track_of("gns+", "paper")


def test_what_rolls_fast_is_followed_in_few_steps() -> None:
    """A ball of ballscroll that turns by 2 rad a frame; a plain step would lose half its spin."""
    motions = motions_of(load_model("hgnn+"), load_scene("ballscroll"))
    (radius,) = motions.graph.mechanism.sphere_radius
    ways = Moments(torch.tensor([radius, 0.0, 0.0]).double(), torch.ones(3).double())
    statistics = dataclasses.replace(Statistics.of(motions), displacement=ways)
    model = build("hgnn+", motions.graph, statistics)
    assert isinstance(model, ImpulseModel)
    assert model.substeps == 1  # 1 rad at twice the usual way, 2 rad a step
    sample = motions.sample(torch.arange(len(motions)), HISTORY - 1, 1)
    state = model.begin(sample.start)
    state[..., 10:] = torch.tensor([0.0, 2.0 / motions.graph.frame_s, 0.0])
    with torch.no_grad():
        smooth, _ = model.predict(state, sample.inputs.at(0))
    assert float((smooth[..., 11] / state[..., 11]).mean()) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("name", ["hgnn+", "lgnn+"])
def test_a_wheel_turns_about_a_centre_of_mass_that_the_world_holds(name: str) -> None:
    """The wheel's centre is a fixed node; a steady spin is followed exactly, as of a free body."""
    wheel = Scene(
        "wheel",
        (Body("wheel", inertia=Inertia(1.0, (0.15, 0.2, 0.15))),),
        1.0,
        joints=(Joint("axle", "hinge", "world", "wheel", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),),
        sampling=(HingeRate(("axle",), (1.0, 30.0)),),
    )
    motions = motions_of(load_model(name), wheel)
    model = _built(name, motions)
    sample = motions.sample(torch.arange(len(motions)), HISTORY - 1, 1)
    state = model.begin(sample.start)
    with torch.no_grad():
        smooth, _ = model.predict(state, sample.inputs.at(0))
    torch.testing.assert_close(smooth[..., W], state[..., W], rtol=1e-3, atol=1e-3)


def test_twists_of_nerd_stay_on_the_joints() -> None:
    """After 20 frames, with noise for corrections, a thousandth of a twist opens joints."""
    motions = motions_of(load_model("nerd"), load_scene("3pendulum"))
    model = _built("nerd", motions)
    sample = motions.sample(torch.arange(len(motions)), HISTORY - 1, 20)
    state = model.begin(sample.start)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.03 * torch.randn(parameter.shape).to(parameter))
        for frame in range(20):
            state = model.advance(state, sample.inputs.at(frame))
    twist = state[:, -1, :, TWIST]
    off = twist - model.rigid.hold(state[:, -1]).kept(twist)
    assert off.norm() < 1e-3 * twist.norm()


@pytest.mark.parametrize("name", ["hgnn+", "lgnn+"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_learned_energies_begin_without_a_force(name: str, seed: int) -> None:
    """Balls in flight keep their velocities, but for a fraction of what gravity would change."""
    motions = motions_of(load_model(name), load_scene("balldrop"))
    model = build(name, motions.graph, Statistics.of(motions), seed=seed)
    assert isinstance(model, ImpulseModel)
    sample = motions.sample(torch.arange(len(motions)), HISTORY - 1, 1)
    state = model.begin(sample.start)
    with torch.no_grad():
        smooth, _ = model.predict(state, sample.inputs.at(0))
    change = float((smooth[..., 7:10] - state[..., 7:10]).norm(dim=-1).max())
    gravity = float(motions.graph.gravity.norm())
    assert change < 0.3 * gravity * motions.graph.frame_s


@pytest.mark.parametrize("name", ["hgnn+", "lgnn+"])
def test_learned_energies_are_followed_to_fourth_order(name: str) -> None:
    """A cube with three driven wheels, whose centres are also tips of the cube."""
    motions = motions_of(load_model(name), load_scene("simplecubli"))
    model = _built(name, motions)
    assert isinstance(model, ImpulseModel)
    sample = motions.sample(torch.arange(len(motions)), HISTORY - 1, 1)
    state = model.begin(sample.start)
    ends = {}
    for model.substeps in (1, 2, 4, 32):
        with torch.no_grad():
            ends[model.substeps], _ = model.predict(state, sample.inputs.at(0))
    errors = [float((ends[count] - ends[32]).norm()) for count in (1, 2, 4)]
    orders = [math.log2(coarse / fine) for coarse, fine in itertools.pairwise(errors)]
    assert orders == pytest.approx([4.0, 4.0], abs=0.4)


@pytest.mark.parametrize("held", [True, False])
def test_nerd_sees_where_the_world_is_if_a_link_holds_a_body_on_it(*, held: bool) -> None:
    """Two states of a pendulum on a rod look different, of a flying ball alike; none has joints."""
    ends = ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    scene = Scene(
        "rod",
        (Body("bob", particles=(Particle(ends[1]),)),),
        1.0,
        distance_links=(DistanceLink("rod", ("world", "bob"), ends),) if held else (),
    )
    model = build("nerd", Graph.of(scene), Statistics.of_nothing(), track="lite")
    assert isinstance(model, NeRD)
    state = torch.zeros(2, HISTORY, 1, 13, dtype=torch.float64)
    state[..., 3] = 1.0
    state[..., :3] = torch.tensor([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8]]).double()[:, None, None]
    inputs = KnownInputs(torch.zeros(2, 1, 3).double(), torch.zeros(2, 0).double())
    hanging, turned = model._seen(state, inputs, *model._base(state))
    assert torch.equal(hanging, turned) != held


def test_nerd_takes_the_world_as_base_if_it_holds_any_body() -> None:
    """A body flies beside another one, which hangs on the world or flies, too."""
    inertia = Inertia(1.0, (0.1, 0.1, 0.1))
    bodies = (Body("a", inertia=inertia), Body("b", inertia=inertia, position=(1.0, 0.0, 0.0)))
    hinge = Joint("h", "hinge", "world", "b", (1.5, 0.0, 0.0), (0.0, 1.0, 0.0))
    for joints, base in (((), 0), ((hinge,), None)):
        graph = Graph.of(Scene("two", bodies, 1.0, joints=joints))
        model = build("nerd", graph, Statistics.of_nothing(), track="lite")
        assert isinstance(model, NeRD)
        assert model.base == base
