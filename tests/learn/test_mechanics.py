"""Mechanisms as nodes: the true energy gives the reference's accelerations."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbds_xsim import rotation
from mbds_xsim.constraints import degrees_of_freedom
from mbds_xsim.errors import Unsupported
from mbds_xsim.joint_space import BodyStates, LinkStates, to_bodies
from mbds_xsim.learn.energy import TrueEnergy, potential_force
from mbds_xsim.learn.hgnn import Hamiltonian
from mbds_xsim.learn.lgnn import Lagrangian
from mbds_xsim.learn.mechanics import Mechanics, constrained
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.reference import accelerations, solve
from mbds_xsim.registry import load_scene
from mbds_xsim.sampling import draw_batch
from mbds_xsim.scene import Body, Inertia, Joint, Scene, SpringDamper

Array = NDArray[np.float64]
torch.set_num_threads(1)

INERTIA = Inertia(2.0, (0.3, 0.4, 0.5), (0.02, -0.03, 0.04), (0.1, 0.2, -0.1))


def every_joint() -> Scene:
    """A tree with every joint kind, a spring and skew inertias."""
    return Scene(
        "every_joint",
        tuple(Body(f"b{k}", inertia=INERTIA, position=(1.0 * k, 0.2 * k, 0.0)) for k in range(6)),
        1.0,
        joints=(
            Joint("h", "hinge", "world", "b0", (0.0, 0.0, 0.0), (1.0, 0.5, 0.2)),
            Joint("s", "slider", "b0", "b1", (0.5, 0.0, 0.0), (0.3, 1.0, 0.2)),
            Joint("f", "fixed", "b1", "b2", (1.5, 0.1, 0.0)),
            Joint("b", "ball", "b3", "b2", (2.5, 0.1, 0.3)),
            Joint("h2", "hinge", "b4", "b3", (3.5, 0.1, 0.3), (0.0, 0.0, 1.0)),
        ),
        springs=(
            SpringDamper("k", ("b0", "b4"), ((0.0, 0.3, 0.0), (3.0, 2.0, 1.0)), 100.0, 3.0, 0.5),
        ),
    )


def tree_states(mechanism: Mechanism) -> BodyStates:
    rng = np.random.default_rng(6)
    shape = (5, mechanism.body_count)
    turn = rng.standard_normal((*shape, 4))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    spin, position, velocity = rng.standard_normal((3, *shape, 3))
    angle, rate = rng.standard_normal((2, *shape))
    return to_bodies(mechanism, LinkStates(turn, spin, angle, rate, position, velocity))


@functools.cache
def recorded_states(name: str) -> BodyStates:
    """Drawn starts, and states along reference trajectories."""
    scene = load_scene(name)
    mechanism = Mechanism.of(scene)
    starts = draw_batch(scene, range(9), noise=False)
    short = starts[:3].truncated(20)
    moved = solve(scene, short)
    whole = [
        np.concatenate([getattr(starts, key), *np.moveaxis(getattr(moved, key), 1, 0)[[7, 20]]])
        for key in ("position", "orientation", "velocity", "angular_velocity")
    ]
    return BodyStates(whole[0], mechanism.native_rotation(whole[1]), whole[2], whole[3])


def states_of(name: str) -> tuple[Scene, BodyStates]:
    if name == "every_joint":
        return every_joint(), tree_states(Mechanism.of(every_joint()))
    return load_scene(name), recorded_states(name)


def reference_accelerations(
    mechanics: Mechanics, bodies: BodyStates, force: Array, torque: Array
) -> Array:
    """Accelerations of the nodes that follow from those of the bodies."""
    linear, angular = accelerations(mechanics.mechanism, bodies, force, torque)
    body, offset = mechanics.points.carrier
    arm = rotation.rotate(bodies.native[:, body], offset)
    spin = bodies.angular_velocity[:, body]
    swing = rotation.cross(spin, rotation.cross(spin, arm))
    return np.asarray(linear[:, body] + rotation.cross(angular[:, body], arm) + swing)


def nodes(mechanics: Mechanics, bodies: BodyStates) -> tuple[Tensor, Tensor]:
    points = mechanics.points
    return (
        torch.as_tensor(points.place(bodies.position, bodies.native)),
        torch.as_tensor(points.move(bodies.native, bodies.velocity, bodies.angular_velocity)),
    )


NAMES = ["6pendulum", "3ladder", "every_joint"]
KINDS = ["mechanics", "lgnn", "hgnn"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_true_energy_reproduces_the_reference(name: str, kind: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    rng = np.random.default_rng(1)
    force = 2.0 * rng.standard_normal(bodies.position.shape)
    torque = rng.standard_normal((len(force), len(mechanics.mechanism.hinges)))
    expected = reference_accelerations(mechanics, bodies, force, torque)
    q, v = nodes(mechanics, bodies)
    push, drive = torch.as_tensor(force), torch.as_tensor(torque)
    energy = TrueEnergy(mechanics)
    if kind == "mechanics":
        load = potential_force(energy, q) + mechanics.applied(q, v, push, drive)
        got = mechanics.acceleration(q, v, load)
    else:
        model = Lagrangian(energy) if kind == "lgnn" else Hamiltonian(energy)
        got = model.acceleration(q, v, push, drive)
    off = np.abs(got.detach().numpy() - expected).max() / np.abs(expected).max()
    print(f"{name} {kind}: {off:.1e}")
    assert off < 1e-8


@pytest.mark.parametrize("name", NAMES)
def test_rows_leave_the_freedoms_of_the_scene(name: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    idle = sum(len(body.tips) == 1 for body in mechanics.points.bodies)
    freedom = degrees_of_freedom(mechanics.mechanism) - idle
    assert 3 * mechanics.free - mechanics.row_count == freedom
    q, v = nodes(mechanics, bodies)
    assert mechanics.residual(q).abs().max() < 1e-9
    rate = mechanics.jacobian(q).along(v)
    assert rate.abs().max() < 1e-9


def test_a_pendulum_is_its_particles() -> None:
    mechanics = Mechanics(load_scene("6pendulum"))
    assert (mechanics.free, mechanics.row_count) == (6, 6)


def test_rows_that_say_the_same_are_dropped() -> None:
    """A planar four-bar of hinges turns, though its hinges' axes are constrained thrice over."""
    corners = [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.2, 0.0, 1.5), (2.0, 0.0, 0.0)]
    bodies = ["world", "crank", "coupler", "rocker", "world"]
    scene = Scene(
        "fourbar",
        tuple(
            Body(name, inertia=Inertia(1.0, (0.1, 0.12, 0.1)), position=(0.7 * k, 0.0, 0.8))
            for k, name in enumerate(bodies[1:4])
        ),
        1.0,
        joints=tuple(
            Joint(f"j{k}", "hinge", bodies[k], bodies[k + 1], corner, (0.0, 1.0, 0.0))
            for k, corner in enumerate(corners)
        ),
    )
    mechanics = Mechanics(scene)
    assert 3 * mechanics.free - mechanics.row_count == 1


@pytest.mark.parametrize("name", ["6pendulum", "every_joint"])
def test_jacobians_are_those_of_the_residual(name: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    q, v = nodes(mechanics, bodies)
    jacobian, rate = mechanics.jacobian(q), mechanics.jacobian_rate(v)
    moved = torch.func.jvp(mechanics.residual, (q,), (v,))[1]
    assert torch.allclose(moved, jacobian.along(v), atol=1e-12)
    turned = torch.func.jvp(lambda at: mechanics.jacobian(at).dense(), (q,), (v,))[1]
    assert torch.allclose(turned, rate.dense(), atol=1e-12)
    assert torch.allclose(rate.along(v), mechanics.bias(v), atol=1e-12)


@pytest.mark.parametrize("name", ["6pendulum", "every_joint"])
def test_jacobians_need_not_be_written_out(name: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    q, v = nodes(mechanics, bodies)
    torch.manual_seed(3)
    for jacobian in (mechanics.jacobian(q), mechanics.jacobian_rate(v)):
        dense, multiplier = jacobian.dense(), torch.randn(len(q), mechanics.row_count).double()
        along = (dense @ v.flatten(1)[..., None])[..., 0]
        assert torch.allclose(along, jacobian.along(v), atol=1e-12)
        back = (dense.mT @ multiplier[..., None])[..., 0]
        assert torch.allclose(back, jacobian.back(multiplier).flatten(1), atol=1e-12)
        mass_inverse = torch.kron(mechanics.mass_inverse, torch.eye(3).double())
        whole = dense @ mass_inverse @ dense.mT
        assert torch.allclose(whole, jacobian.over_mass(), atol=1e-12 * float(whole.abs().max()))


@pytest.mark.parametrize("name", NAMES)
def test_projection_closes_the_joints(name: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    q, v = nodes(mechanics, bodies)
    torch.manual_seed(2)
    small = 1e-3 * mechanics.points.rod_length.min()
    loose = (q + small * torch.randn_like(q), v + small * torch.randn_like(v))
    before = mechanics.residual(loose[0]).abs().max()
    closed, slowed = mechanics.project(*loose, passes=3)
    assert mechanics.residual(closed).abs().max() < 1e-8 * before
    rate = mechanics.jacobian(closed).along(slowed)
    assert rate.abs().max() < 1e-12
    same, again = mechanics.project(q, v)
    assert torch.allclose(same, q, atol=1e-9)
    assert torch.allclose(again, v, atol=1e-9)


def test_contact_is_refused() -> None:
    with pytest.raises(Unsupported, match=r"balldrop.*contact.*gns or sgnn"):
        Mechanics(load_scene("balldrop"))


def test_the_gradient_of_constrained_accelerations_is_right() -> None:
    generator = torch.Generator().manual_seed(5)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator).requires_grad_()

    def solve_with_any(root: Tensor, load: Tensor, jacobian: Tensor, bias: Tensor) -> Tensor:
        mass = root @ root.mT + torch.eye(5, dtype=root.dtype)
        return constrained(mass, load, jacobian, bias)

    inputs = (draw(2, 5, 5), draw(2, 5), draw(2, 3, 5), draw(2, 3))
    assert torch.autograd.gradcheck(solve_with_any, inputs)
    moved = solve_with_any(*inputs)
    assert torch.allclose((inputs[2] @ moved[..., None])[..., 0], -inputs[3], atol=1e-10)
