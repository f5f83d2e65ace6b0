"""Shared parts of the LGNN and HGNN tests: an untrained energy, states, a Runge-Kutta method."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from mbds_xsim.learn.energy import EnergyNetwork, EnergyShape, Kinetic, momentum
from mbds_xsim.learn.energy_models import Hamiltonian, NodeDynamics
from mbds_xsim.learn.mechanics import Mechanics
from mbds_xsim.learn.window import KnownInputs
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import load_scene

torch.set_num_threads(1)


class TrueEnergy(nn.Module):
    """The scene's own energy."""

    def __init__(self, mechanics: Mechanics) -> None:
        super().__init__()
        self.mechanics = mechanics

    def kinetic(self, v: Tensor) -> Kinetic:
        square, half = (
            (self.mechanics.speed_map @ v).square().sum(-1),
            0.5 * self.mechanics.moved_mass,
        )
        return Kinetic(half * square, half.expand_as(square), torch.zeros_like(square))

    def potential(self, q: Tensor) -> Tensor:
        mass = self.mechanics.moved_mass[: self.mechanics.free, None]
        gravity = torch.tensor(self.mechanics.mechanism.scene.gravity, dtype=torch.float64)
        weight = -(mass * q * gravity).sum((-1, -2))
        span = torch.linalg.vector_norm(self.mechanics.spring @ self.mechanics.all_nodes(q), dim=-1)
        stiffness, rest = self.mechanics.spring_law[:, 0], self.mechanics.spring_law[:, 1]
        return weight + 0.5 * (stiffness * (span - rest) ** 2).sum(-1)


def random_energy(scene: Scene | str, width: int = 5, seed: int = 3) -> EnergyNetwork:
    """Return an untrained energy; all parameters are shaken so that kinds differ."""
    torch.manual_seed(seed)
    scene = load_scene(scene) if isinstance(scene, str) else scene
    energy = EnergyNetwork(Mechanics(scene), EnergyShape(width=width)).double()
    for parameter in energy.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    return energy


def drawn_states(mechanics: Mechanics, count: int = 6) -> tuple[Tensor, Tensor]:
    batch = draw_batch(mechanics.mechanism.scene, range(count), noise=False)
    return nodes(mechanics, BodyStates.of(mechanics.mechanism, batch))


def nodes(mechanics: Mechanics, bodies: BodyStates) -> tuple[Tensor, Tensor]:
    carrier = mechanics.points.carrier
    placed, moving = bodies.points(*carrier), bodies.speeds(*carrier)
    return torch.tensor(placed.copy()), torch.tensor(moving.copy())


def total_energy(dynamics: NodeDynamics, q: Tensor, x: Tensor) -> Tensor:
    """Return the energy q̇ · ∂L/∂q̇ − L of a Lagrangian, or H [J], shape (batch,)."""
    v = dynamics.velocity(x)
    kinetic, potential = dynamics.energy.kinetic(v), dynamics.energy.potential(q)
    if isinstance(dynamics, Hamiltonian):
        return kinetic.value.sum(-1) + potential
    action = (v * momentum(dynamics.mechanics, kinetic, v)).sum((-1, -2))
    return action - kinetic.value.sum(-1) + potential


def acceleration(dynamics: NodeDynamics, q: Tensor, v: Tensor, *inputs: Tensor) -> Tensor:
    """Return node accelerations [m/s²]; of a Hamiltonian M⁻¹ ṗ at p = M v (q̈ if H is true)."""
    return dynamics.velocity(dynamics.derivative(q, dynamics.conjugate(v), KnownInputs(*inputs))[1])


def no_inputs(mechanics: Mechanics, count: int) -> tuple[Tensor, Tensor]:
    bodies, hinges = mechanics.mechanism.body_count, len(mechanics.mechanism.hinges)
    return (
        torch.zeros(count, bodies, 3, dtype=torch.float64),
        torch.zeros(count, hinges, dtype=torch.float64),
    )


def march(rate: Callable[[Tensor], Tensor], state: Tensor, steps: int, duration: float) -> Tensor:
    step = duration / steps
    for _ in range(steps):
        first = rate(state)
        second = rate(state + 0.5 * step * first)
        third = rate(state + 0.5 * step * second)
        fourth = rate(state + step * third)
        state = state + step / 6.0 * (first + 2.0 * (second + third) + fourth)
    return state
