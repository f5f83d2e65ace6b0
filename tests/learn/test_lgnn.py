"""LGNN: closed-form mass matrix, energy along a rollout, permutations of nodes."""

from __future__ import annotations

import functools
import math

import msgspec
import pytest
import torch
from torch import Tensor

from mbds_xsim.learn.energy import (
    Drag,
    EnergyNetwork,
    EnergyShape,
    MassMatrix,
    OfDistances,
    momentum,
)
from mbds_xsim.learn.energy_models import Hamiltonian, Lagrangian
from mbds_xsim.learn.mechanics import Mechanics
from mbds_xsim.learn.window import KnownInputs
from mbds_xsim.scene.scene import Body, Particle, Scene, SpringDamper
from mbds_xsim.simulate.registry import load_scene

from .energies import acceleration, drawn_states, march, no_inputs, random_energy, total_energy
from .mechanisms import scene_of


@pytest.mark.parametrize("name", ["6pendulum", "3ladder"])
def test_the_mass_matrix_is_the_hessian(name: str) -> None:
    energy = random_energy(name)
    _, v = drawn_states(energy.mechanics, 3)
    v = v + torch.randn(v.shape, dtype=v.dtype, generator=torch.Generator().manual_seed(1))

    def kinetic(flat: Tensor) -> Tensor:
        return energy.kinetic(flat.view(1, -1, 3)).value.sum(-1)[0]

    mass = MassMatrix(energy, v)
    by_hand = mass.dense()
    assert torch.allclose(mass.times(v).flatten(1), (by_hand @ v.flatten(1)[..., None])[..., 0])
    slope = momentum(energy.mechanics, energy.kinetic(v), v)
    for k, one in enumerate(v):
        flat = one.flatten()
        hessian = torch.func.jacrev(torch.func.grad(kinetic))(flat)
        assert (by_hand[k] - hessian).abs().max() < 1e-10 * hessian.abs().max()
        gradient = torch.func.grad(kinetic)(flat)
        assert (slope[k].flatten() - gradient).abs().max() < 1e-10 * gradient.abs().max()
    assert (by_hand.diagonal(dim1=-2, dim2=-1) > 0).all()


def test_the_mass_matrix_is_positive_whatever_the_parameters() -> None:
    energy = random_energy("6pendulum")
    with torch.no_grad():
        for seed in range(5):
            torch.manual_seed(seed)
            for parameter in energy.parameters():
                parameter.copy_(3.0 * torch.randn_like(parameter))
            v = 10.0 * torch.randn(16, 6, 3, dtype=torch.float64)
            values = torch.linalg.eigvalsh(MassMatrix(energy, v).dense())
            assert values.min() > 0


@pytest.mark.parametrize("name", ["6pendulum", "3ladder"])
@pytest.mark.parametrize("dynamics", [Lagrangian, Hamiltonian])
def test_what_distances_that_nothing_changes_store_moves_nothing(
    name: str, dynamics: type[Lagrangian | Hamiltonian]
) -> None:
    """The energy leaves constant distances out; without springs all distances are constant."""
    energy = random_energy(name)
    assert energy.of_place.of_distances is None
    model = dynamics(energy)
    q, v = drawn_states(energy.mechanics)
    inputs = no_inputs(energy.mechanics, len(q))
    without, stored = acceleration(model, q, v, *inputs), energy.potential(q)
    more = OfDistances(energy.mechanics, EnergyShape()).double()
    for parameter in more.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    energy.of_place.of_distances = more
    assert (energy.potential(q) - stored).abs().max() > 0.1 * stored.abs().max()
    apart = (acceleration(model, q, v, *inputs) - without).abs().max()
    assert apart < 1e-10 * without.abs().max()


@pytest.mark.parametrize("kind", [Lagrangian, Hamiltonian])
@pytest.mark.parametrize(("name", "steps"), [("6pendulum", 10), ("3ladder", 20)])
def test_a_learned_energy_is_kept(
    name: str, steps: int, kind: type[Lagrangian | Hamiltonian]
) -> None:
    """The drift is of fourth order like the method: it comes from the integrator alone."""
    energy = random_energy(name)
    model = kind(energy)
    q, v = drawn_states(energy.mechanics, 3)
    x = model.conjugate(v)
    inputs = no_inputs(energy.mechanics, len(q))

    def rate(state: Tensor) -> Tensor:
        q, x = state.unbind(1)
        return torch.stack(model.derivative(q, x, KnownInputs(*inputs)), dim=1)

    with torch.no_grad():
        before = total_energy(model, q, x)
        speed = energy.kinetic(v).value.sum(-1).abs().max()
        start = torch.stack([q, x], dim=1)
        drifts = []
        for count in (steps, 2 * steps):
            end = march(rate, start, count, 0.05)
            after = total_energy(model, end[:, 0], end[:, 1])
            drifts.append(float((after - before).abs().max()))
    order = math.log2(drifts[0] / drifts[1])
    print(f"{name}: drift {drifts[1] / speed:.1e} of the kinetic energy, order {order:.2f}")
    assert order > 3.7
    assert drifts[1] < 1e-9 * speed


def test_drag_only_takes_energy() -> None:
    energy = random_energy("3ladder")
    drag = Drag(energy, EnergyShape()).double()
    for seed in range(4):
        torch.manual_seed(seed)
        for parameter in drag.parameters():
            parameter.data = torch.randn_like(parameter)
        v = 5.0 * torch.randn(8, energy.mechanics.free, 3, dtype=torch.float64)
        assert ((drag(v) * v).sum((1, 2)) < 0).all()


@pytest.mark.parametrize("name", ["3ladder", "four-bar", "bricard"])
@pytest.mark.parametrize("dynamics", [Lagrangian, Hamiltonian])
def test_accelerations_follow_the_parameters(
    name: str, dynamics: type[Lagrangian | Hamiltonian]
) -> None:
    """The gradient by parameters equals central differences, also with redundant rows."""
    energy = random_energy(scene_of(name))
    model, inputs = dynamics(energy), no_inputs(energy.mechanics, 2)
    q, v = drawn_states(energy.mechanics, 2)
    torch.manual_seed(7)
    weight = torch.randn_like(q)
    used = [parameter for parameter in energy.parameters() if parameter.requires_grad]
    way = [torch.randn_like(parameter) for parameter in used]

    def moved(size: float) -> Tensor:
        for parameter, step in zip(used, way, strict=True):
            parameter.data += size * step
        total = (weight * acceleration(model, q, v, *inputs)).sum()
        for parameter, step in zip(used, way, strict=True):
            parameter.data -= size * step
        return total

    slopes = torch.autograd.grad(moved(0.0), used, allow_unused=True, materialize_grads=True)
    along = sum(float((slope * step).sum()) for slope, step in zip(slopes, way, strict=True))
    small = 1e-4
    change = (moved(small) - moved(-small)).item() / (2.0 * small)
    assert change == pytest.approx(along, rel=1e-5)


@pytest.mark.parametrize("name", ["6pendulum", "3ladder"])
def test_energy_falls_by_the_power_of_drag(name: str) -> None:
    energy = random_energy(name)
    drag = Drag(energy, EnergyShape()).double()
    for parameter in drag.parameters():
        parameter.data = torch.randn_like(parameter)
    q, v = drawn_states(energy.mechanics)
    v, inputs = v + 0.0, no_inputs(energy.mechanics, len(q))
    lagrangian, hamiltonian = Lagrangian(energy, drag), Hamiltonian(energy, drag)
    a = acceleration(lagrangian, q, v, *inputs)
    lost = torch.func.jvp(functools.partial(total_energy, lagrangian), (q, v), (v, a))[1]
    power = (drag(v) * v).sum((1, 2))
    assert (power < 0).all()
    assert torch.allclose(lost, power, rtol=1e-8)
    p = hamiltonian.conjugate(v)
    q_rate, p_rate = hamiltonian.derivative(q, p, KnownInputs(*inputs))
    lost = torch.func.jvp(functools.partial(total_energy, hamiltonian), (q, p), (q_rate, p_rate))[1]
    assert torch.allclose(lost, (drag(q_rate) * q_rate).sum((1, 2)), rtol=1e-8)


def test_springs_are_told_apart_by_their_laws_and_not_by_their_ends() -> None:
    def potential(springs: tuple[tuple[str, str, float], ...]) -> Tensor:
        """Return that of three like bodies, the middle one nearer to the first."""
        place = {"a": (0.0, 0.0, 0.0), "b": (1.0, 0.1, 0.0), "c": (2.5, 0.0, 0.3)}
        scene = Scene(
            "three",
            tuple(Body(name, particles=(Particle(at),)) for name, at in place.items()),
            1.0,
            springs=tuple(
                SpringDamper(f"{one}{two}", (one, two), (place[one], place[two]), stiffness, 0.1)
                for one, two, stiffness in springs
            ),
        )
        energy = random_energy(scene)
        return energy.potential(drawn_states(energy.mechanics, 1)[0])

    unlike = potential((("a", "b", 1.0), ("b", "c", 1000.0)))
    other = potential((("a", "b", 1000.0), ("b", "c", 1.0)))
    assert (unlike - other).abs() > 1e-6 * unlike.abs()
    turned = potential((("b", "a", 1.0), ("c", "b", 1000.0)))
    assert torch.allclose(unlike, turned, rtol=1e-12)


@pytest.mark.parametrize("dynamics", [Lagrangian, Hamiltonian])
def test_a_plane_motion_stays_in_its_plane(dynamics: type[Lagrangian | Hamiltonian]) -> None:
    chain = load_scene("2pendulum")
    energy = random_energy(msgspec.structs.replace(chain, dimension=2, sampling=()))
    drag = Drag(energy, EnergyShape()).double()
    q, v = drawn_states(energy.mechanics, 1)
    v[:, :, 0] += torch.tensor([1.0, 3.0])
    a = acceleration(dynamics(energy, drag), q, v, *no_inputs(energy.mechanics, 1))
    assert (a[..., 1] == 0.0).all()
    assert (a[..., [0, 2]].abs() > 0.0).all()


def renamed(scene: Scene) -> Scene:
    """The same scene with its bodies listed backwards (so particles and nodes change places)."""
    return msgspec.structs.replace(scene, bodies=scene.bodies[::-1], edges=(), anchors=())


@pytest.mark.parametrize("dynamics", [Lagrangian, Hamiltonian])
def test_nodes_in_another_order_move_alike(dynamics: type[Lagrangian | Hamiltonian]) -> None:
    energy = random_energy("3ladder")
    mechanics = energy.mechanics
    other = Mechanics(renamed(mechanics.mechanism.scene))
    copy = EnergyNetwork(other, EnergyShape()).double()
    copy.load_state_dict(energy.state_dict())
    q, v = drawn_states(mechanics, 3)
    place, speed = drawn_states(other, 3)
    order = torch.cdist(q[0] + v[0], place[0] + speed[0]).argmin(dim=0)
    force, torque = no_inputs(mechanics, 3)
    force = force + torch.randn(force.shape, dtype=v.dtype, generator=torch.Generator())
    one = acceleration(dynamics(energy), q, v, force, torque)[:, order]
    two = acceleration(dynamics(copy), q[:, order], v[:, order], force.flip(1), torque)
    assert not torch.equal(order, torch.arange(len(order)))
    assert (one - two).abs().max() < 1e-9 * one.abs().max()
