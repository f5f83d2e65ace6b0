"""Smooth motion of rigid bodies in torch: joints, order, flight, and motions that joints allow."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor

from mbds_xsim.base.errors import Unsupported
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import refusal
from mbds_xsim.learn.rigid import BodyMechanics, JointHold, Links
from mbds_xsim.learn.window import KnownInputs
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.constraints import constraint_rows, dense_jacobian
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene, SpringDamper
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.cases import CASES

_FRAMES = 10


def _case(name: str) -> Scene:
    return next(case.scene for case in CASES if case.name == name)


def _states(graph: Graph, motion: Batch | Trajectory) -> Tensor:
    native = graph.mechanism.native_rotation(motion.orientation)
    parts = (motion.position, native, motion.velocity, motion.angular_velocity)
    return torch.from_numpy(np.concatenate(parts, axis=-1))


def _solved(scene: Scene, rows: int = 3) -> tuple[Batch, Trajectory]:
    batch = draw_batch(scene, range(rows)).truncated(_FRAMES)
    return batch, solve(scene, batch)


def _rolled(graph: Graph, batch: Batch, substeps: int) -> Tensor:
    bodies, state = BodyMechanics(graph), _states(graph, batch)
    for frame in range(_FRAMES):
        acting = KnownInputs(
            *map(torch.from_numpy, (batch.force[:, frame], batch.torque[:, frame]))
        )
        state = bodies.smooth(state, acting, graph.frame_s, substeps)[0][-1]
    return state


def _dense(hold: JointHold) -> Tensor:
    """Return the Jacobian by the twists of all bodies, shape (batch, row, 6 · body)."""
    ends, count = hold.rows.ends, len(hold.rows)
    whole = hold.jacobian.new_zeros(len(hold.jacobian), count, hold.rows.body_count + 1, 6)
    whole[:, torch.arange(len(ends)) % count, ends] = hold.jacobian
    return whole[:, :, :-1].flatten(2)


_JOINTED = ["rod", "slider", "flywheel", "parallelogram", "ball loop", "linked", "wedge", "welded"]


@pytest.mark.parametrize("name", _JOINTED)
def test_rows_are_those_of_the_scene(name: str) -> None:
    """Residuals and Jacobians agree for bodies anywhere and for every form of row."""
    graph = Graph.of(_case(name))
    state = torch.from_numpy(np.random.default_rng(3).normal(size=(4, graph.body_count, 13)))
    state[..., 3:7] /= state[..., 3:7].norm(dim=-1, keepdim=True)
    parts = np.split(state.numpy(), (3, 7, 10), axis=-1)
    rows = constraint_rows(graph.mechanism, BodyStates(*parts))
    bodies = BodyMechanics(graph)
    hold = bodies.hold(state)
    np.testing.assert_allclose(bodies.residual(state).numpy(), rows.residual, atol=1e-12)
    dense = dense_jacobian(rows, graph.body_count)
    np.testing.assert_allclose(_dense(hold).numpy(), dense, atol=1e-12)


@pytest.mark.parametrize("name", ["tumbling", "spin-up in flight", "3pendulum", "parallelogram"])
def test_smooth_motion_is_of_second_order(name: str) -> None:
    """Halved steps bring it four times nearer to the reference, with joints, loops and drives."""
    scene = load_scene(name) if name == "3pendulum" else _case(name)
    graph = Graph.of(scene)
    batch, truth = _solved(scene)
    there, bodies = _states(graph, truth)[:, _FRAMES], BodyMechanics(graph)
    coarse, fine = (bodies.apart(there, _rolled(graph, batch, n)).norm() for n in (2, 4))
    assert 3.6 < coarse / fine < 4.4


def test_a_flying_body_is_exact() -> None:
    """Planar flight is exact whatever the step is."""
    graph = Graph.of(load_scene("balldrop"))
    batch, truth = _solved(graph.scene)
    there = _states(graph, truth)[:, _FRAMES]
    torch.testing.assert_close(_rolled(graph, batch, 1), there, atol=1e-9, rtol=0.0)


@pytest.mark.parametrize("name", ["rod", "slider", "flywheel", "chain of balls", "welded"])
def test_motions_of_links_are_those_that_joints_allow(name: str) -> None:
    """Motions of links open no joint, and every motion that joints allow is one of them."""
    graph = Graph.of(_case(name))
    _, truth = _solved(graph.scene)
    state = _states(graph, truth)[:, 3]
    hold = BodyMechanics(graph).hold(state)
    links = Links(graph.mechanism)
    each = torch.eye(6 * graph.body_count).double().reshape(-1, graph.body_count, 6)
    for pose, jacobian in zip(state, _dense(hold), strict=True):
        twists = links(pose.expand(len(each), -1, -1), each[..., :3], each[..., 3:]).flatten(1)
        assert (jacobian @ twists.T).abs().max() < 1e-9
        free = jacobian.shape[1] - torch.linalg.matrix_rank(jacobian)
        assert torch.linalg.matrix_rank(twists) == free


def test_joints_take_the_least_of_a_change() -> None:
    """The change that is left opens no joint; the part taken is mass-orthogonal to it."""
    graph = Graph.of(_case("parallelogram"))
    _, truth = _solved(graph.scene)
    state, bodies = _states(graph, truth)[:, 2], BodyMechanics(graph)
    hold = bodies.hold(state)
    change = torch.from_numpy(np.random.default_rng(5).normal(size=(3, graph.body_count, 6)))
    kept = hold.kept(change)
    assert (_dense(hold) @ kept.flatten(1)[..., None]).abs().max() < 1e-6
    whole, left, taken = (bodies.square(state, each) for each in (change, kept, change - kept))
    torch.testing.assert_close(whole, left + taken, rtol=1e-6, atol=0.0)


def test_springs_in_joints_are_refused_in_a_line() -> None:
    """The line says what is allowed and which model to take instead."""
    with pytest.raises(Unsupported, match=r"joint 'axle': got a spring.*none: .*give its bodies"):
        BodyMechanics(Graph.of(_case("sprung hinge")))
    scene = load_scene("2pendulum")
    first, second = (body.name for body in scene.bodies)
    spring = SpringDamper("bow", (first, second), ((0.0, 0.0, -0.1), (0.0, 0.0, -0.2)), 1.0)
    sprung = Graph.of(msgspec.structs.replace(scene, springs=(spring,)))
    assert refusal("hgnn", sprung) == ""
    with pytest.raises(Unsupported, match=r"spring 'bow'.*; take hgnn, lgnn, gns or sgnn$"):
        BodyMechanics(sprung)
