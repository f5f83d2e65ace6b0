"""Mechanisms as nodes: the true energy gives the reference's accelerations."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.energy_models import Hamiltonian, Lagrangian
from mbds_xsim.learn.mechanics import Jacobian, Mechanics, constrained
from mbds_xsim.learn.window import KnownInputs
from mbds_xsim.reference import accelerations, solve
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_bodies
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import load_scene

from .energies import TrueEnergy, acceleration, march, no_inputs, nodes
from .mechanisms import scene_of

torch.set_num_threads(1)


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
    scene = scene_of(name)
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
    scene = scene_of(name)
    if name == "every_joint":
        return scene, tree_states(Mechanism.of(scene))
    return scene, recorded_states(name)


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


LOOPS = ["andrews", "bricard", "workbench", "four-bar"]
NAMES = ["6pendulum", "3ladder", "every_joint", "linked", *LOOPS]
KINDS = ["lgnn", "hgnn"]


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
    model = Lagrangian(energy) if kind == "lgnn" else Hamiltonian(energy)
    got = acceleration(model, q, v, push, drive)
    off = np.abs(got.detach().numpy() - expected).max() / np.abs(expected).max()
    print(f"{name} {kind}: {off:.1e}")
    assert off < 1e-8


@pytest.mark.parametrize("name", NAMES)
def test_rows_leave_the_freedoms_of_the_scene(name: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    idle = sum(len(body.tips) == 1 for body in mechanics.points.bodies)
    freedom = degrees_of_freedom(mechanics.mechanism) - idle
    assert 3 * mechanics.free - len(mechanics.goal) + mechanics.redundant == freedom
    assert (mechanics.redundant > 0) == (name in LOOPS)
    q, v = nodes(mechanics, bodies)
    assert mechanics.residual(q).abs().max() < 1e-9
    rate = mechanics.jacobian(q).along(v)
    assert rate.abs().max() < 1e-9


def test_a_pendulum_is_its_particles() -> None:
    mechanics = Mechanics(load_scene("6pendulum"))
    assert (mechanics.free, len(mechanics.goal)) == (6, 6)


def rate_of(kind: str, energy: TrueEnergy, force: Tensor, torque: Tensor, state: Tensor) -> Tensor:
    """Rate of nodes and their velocities, or momenta, under forces and torques."""
    model = Lagrangian(energy) if kind == "lgnn" else Hamiltonian(energy)
    q, x = state.unbind(1)
    return torch.stack(model.derivative(q, x, KnownInputs(force, torque)), dim=1)


@pytest.mark.parametrize("kind", ["lgnn", "hgnn"])
@pytest.mark.parametrize("name", LOOPS)
def test_loops_move_as_the_reference(name: str, kind: str) -> None:
    """The needed ones of redundant rows change on the way; the order stays the method's fourth."""
    scene = scene_of(name)
    steps = min(120, scene.clock.steps)
    start = draw_batch(scene, [0], noise=False).truncated(steps)
    moved, mechanics = solve(scene, start), Mechanics(scene)
    q, v = nodes(
        mechanics,
        BodyStates(
            moved.position[0],
            mechanics.mechanism.native_rotation(moved.orientation[0]),
            moved.velocity[0],
            moved.angular_velocity[0],
        ),
    )
    energy = TrueEnergy(mechanics)
    first = v[:1] if kind == "lgnn" else mechanics.mass @ v[:1]
    force, torque = torch.as_tensor(start.force), torch.as_tensor(start.torque)

    def end(substeps: int) -> Tensor:
        state = torch.stack([q[:1], first], dim=1)
        for frame in range(steps):
            push, turn = force[:, frame], torque[:, frame]
            rate = functools.partial(rate_of, kind, energy, push, turn)
            state = march(rate, state, substeps, scene.clock.frame)
        return state[0, 0]

    with torch.no_grad():
        errors = [float((end(k) - q[-1]).abs().max()) / scene.length for k in (1, 2)]
    print(f"{name} {kind}: {errors[1]:.1e}, order {math.log2(errors[0] / errors[1]):.2f}")
    assert errors[1] < 1e-3
    assert math.log2(errors[0] / errors[1]) > 3.5


@dataclass
class Dense:
    """A mass matrix or Jacobian that is written out, shape (batch, n, 3 · node)."""

    matrix: Tensor

    def dense(self) -> Tensor:
        return self.matrix

    def along(self, v: Tensor) -> Tensor:
        return (self.matrix @ v.flatten(1)[..., None])[..., 0]

    def times(self, v: Tensor) -> Tensor:
        return self.along(v).view_as(v)

    def back(self, multiplier: Tensor) -> Tensor:
        return (self.matrix.mT @ multiplier[..., None]).view(len(multiplier), -1, 3)


def held(root: Tensor, load: Tensor, rows: Tensor, bias: Tensor, redundant: int = 0) -> Tensor:
    """Return accelerations with the mass matrix 1 + root · rootᵀ."""
    mass = root @ root.mT + torch.eye(root.shape[-1], dtype=root.dtype)
    return constrained(Dense(mass), load, cast(Jacobian, Dense(rows)), bias, redundant)


def test_gradients_go_through_redundant_rows() -> None:
    """Values and gradients by mass matrix and loads are the same as without redundant rows."""
    generator = torch.Generator().manual_seed(5)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator)

    rows, bias = draw(2, 3, 6), draw(2, 3)
    mix = torch.cat([torch.eye(3), draw(2, 3).float()]).double()
    jacobian, same = mix @ rows, (mix @ bias[..., None])[..., 0]

    root, load = draw(2, 6, 6).requires_grad_(), draw(2, 2, 3).requires_grad_()
    values = [held(root, load, jacobian, same, 2), held(root, load, rows, bias)]
    assert torch.allclose(values[0], values[1], atol=1e-10)
    slopes = [torch.autograd.grad(value.pow(2).sum(), (root, load)) for value in values]
    for one, other in zip(*slopes, strict=True):
        assert torch.allclose(one, other, atol=1e-9)


@pytest.mark.parametrize("name", ["6pendulum", "every_joint", "linked"])
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


@pytest.mark.parametrize("name", ["6pendulum", "every_joint", "linked"])
def test_jacobians_need_not_be_written_out(name: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    q, v = nodes(mechanics, bodies)
    torch.manual_seed(3)
    for jacobian in (mechanics.jacobian(q), mechanics.jacobian_rate(v)):
        dense, multiplier = jacobian.dense(), torch.randn(len(q), len(mechanics.goal)).double()
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


@pytest.mark.parametrize("name", ["6pendulum", "bricard"])
def test_a_lost_state_takes_no_other_along(name: str) -> None:
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    q, v = nodes(mechanics, bodies)
    lost = q.clone()
    lost[1] = torch.nan
    (sound, slow), (closed, slowed) = (mechanics.project(at, v) for at in (q, lost))
    others = torch.arange(len(q)) != 1
    assert torch.equal(closed[others], sound[others])
    assert torch.equal(slowed[others], slow[others])
    assert closed[1].isnan().all()
    for at, kind in itertools.product((q, lost), (Lagrangian, Hamiltonian)):
        moved = acceleration(kind(TrueEnergy(mechanics)), at, v, *no_inputs(mechanics, len(q)))
        assert moved[others].isfinite().all()
        assert moved[1].isnan().all() == (at is lost)


def test_the_gradient_of_constrained_accelerations_is_right() -> None:
    generator = torch.Generator().manual_seed(5)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator).requires_grad_()

    inputs = (draw(2, 6, 6), draw(2, 2, 3), draw(2, 3, 6), draw(2, 3))
    assert torch.autograd.gradcheck(held, inputs)
    assert torch.allclose(Dense(inputs[2]).along(held(*inputs)), -inputs[3], atol=1e-10)


@pytest.mark.parametrize("name", ["6pendulum", "every_joint"])
def test_the_gradient_of_the_projection_is_right(name: str) -> None:
    """The gradient is checked at loose states, whose nodes are about a hundredth of a rod off."""
    scene, bodies = states_of(name)
    mechanics = Mechanics(scene)
    q, v = (part[:1] for part in nodes(mechanics, bodies))
    small = 1e-2 * float(mechanics.points.rod_length.min())
    torch.manual_seed(4)
    loose = tuple((x + small * torch.randn_like(x)).requires_grad_() for x in (q, v))
    assert torch.autograd.gradcheck(mechanics.project, loose, eps=1e-7, atol=1e-5, rtol=1e-5)
