"""Graphs have the scene's nodes and edges, whatever its kind."""

import re

import msgspec
import pytest
import torch

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import refusal
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Joint, Particle, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene
from mbds_xsim.testing.collision_cases import TWO, balls


@pytest.mark.parametrize("name", PAPER_SCENES)
def test_edges_go_both_ways_and_masses_are_the_bodies(name: str) -> None:
    scene = load_scene(name)
    graph = Graph.of(scene)
    there = set(zip(graph.senders.tolist(), graph.receivers.tolist(), strict=True))
    listed = {(a, b) for a, b in scene.edges}
    assert there == listed | {(b, a) for a, b in listed}
    assert graph.static.sum() == len(scene.anchors)
    mass = torch.zeros(graph.body_count, dtype=torch.float64)
    moved = ~graph.static
    mass.index_add_(0, graph.body[moved], graph.mass[moved])
    torch.testing.assert_close(mass, torch.from_numpy(Mechanism.of(scene).mass))


def test_inner_edges_join_particles_of_one_body() -> None:
    graph = Graph.of(load_scene("particlecar"))
    ends = graph.body[graph.senders], graph.body[graph.receivers]
    assert torch.equal(graph.inner, ends[0] == ends[1])
    assert 0 < graph.inner.sum() < len(graph.senders)


def test_a_single_particle_has_no_edges() -> None:
    graph = Graph.of(load_scene("ballscroll"))
    assert (graph.node_count, len(graph.senders)) == (1, 0)
    assert graph.senders.dtype == torch.int64


def test_anchors_are_nodes_of_no_body() -> None:
    graph = Graph.of(load_scene("6pendulum"))
    assert graph.body.tolist() == [0, 1, 2, 3, 4, 5, -1]
    assert not graph.inner.any()
    particles = torch.rand(2, 4, 6, 3)
    nodes = graph.with_anchors(particles)
    assert torch.equal(nodes[..., :6, :], particles)
    torch.testing.assert_close(
        nodes[0, 0, 6].double(), torch.tensor(graph.scene.anchors[0], dtype=torch.float64)
    )


def test_bodies_without_particles_have_stand_ins_and_edges_keep_their_anchor() -> None:
    scene = load_scene("2pendulum")
    block = Body("block", inertia=Inertia(2.0, (0.1, 0.1, 0.1)), position=(0.0, 3.0, 0.0))
    graph = Graph.of(msgspec.structs.replace(scene, bodies=(*scene.bodies, block)))
    assert graph.node_count == 2 + 6 + 1
    assert graph.mass[2:8].sum() == pytest.approx(2.0)
    assert (8, 0) in set(zip(graph.senders.tolist(), graph.receivers.tolist(), strict=True))


def test_positions_in_the_plane_get_their_depth_back() -> None:
    graph = Graph.of(load_scene("balldrop"))
    published = torch.rand(5, graph.particle_count, 2)
    whole = graph.embed(published)
    assert torch.equal(whole[..., [0, 2]], published)
    expected = graph.reference[:, 1].float().expand(5, graph.particle_count)
    assert torch.equal(whole[..., 1], expected)
    assert graph.embed(published, rest=0.0)[..., 1].abs().max() == 0


def test_bodies_that_collide_with_each_other_have_no_graph() -> None:
    with pytest.raises(InputError, match=r"scene 'balls': got \[collisions\], allowed are scenes"):
        Graph.of(balls(TWO["head on"]))


@pytest.mark.parametrize("limit", [10.0, None])
@pytest.mark.parametrize("targets", [(0.0, 0.3, -0.3), (0.3,)])
def test_targets_that_change_are_refused_where_no_input_shows_them(
    limit: float | None, targets: tuple[float, ...]
) -> None:
    scene = Scene(
        "servo",
        (Body("cart", particles=(Particle((0.0, 0.0, 0.0)),)),),
        1.0,
        joints=(Joint("rail", "slider", "world", "cart", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),),
        servos=(Servo("rail", targets, stiffness=50.0, damping=5.0, hold=20, limit=limit),),
    )
    if limit is None or len(targets) == 1:
        assert Graph.of(scene).node_count == 1
        return
    with pytest.raises(Unsupported, match=r"^servo of 'rail': got targets that change, allowed"):
        Graph.of(scene)


@pytest.mark.parametrize("name", ["gns", "sgnn"])
def test_joined_bodies_without_edges_are_refused_where_only_edges_show_joints(name: str) -> None:
    words = "got joined bodies and no edges, needed are edges: .*give its bodies particles and"
    assert re.search(words + r" edges, or take gns\+ or", refusal(name, Graph.of(_stand_ins())))
    loaded = refusal(name, Graph.of(_stand_ins(damping=1.0)))
    assert re.search(words + " edges$", loaded)
    assert refusal("gns+", Graph.of(_stand_ins())) == ""
    assert refusal(name, Graph.of(load_scene("ballscroll"))) == ""


@pytest.mark.parametrize("name", ["gns+", "hgnn"])
def test_models_that_would_be_refused_are_not_advised(name: str) -> None:
    advice = refusal(name, Graph.of(_stand_ins(damping=1.0)))
    assert advice.endswith("; give its bodies particles and edges, and take gns or sgnn")


def _stand_ins(*, damping: float = 0.0) -> Scene:
    """A double pendulum of bodies given by their inertia."""
    bodies = tuple(
        Body(name, inertia=Inertia(1.0, (0.1, 0.1, 0.1)), position=(0.0, 0.0, height))
        for name, height in (("a", -0.5), ("b", -1.5))
    )
    joints = (
        Joint("j", "hinge", "world", "a", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), damping=damping),
        Joint("k", "hinge", "a", "b", (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    )
    return Scene("two", bodies, 1.0, joints=joints)
