"""HGNN: energy along a rollout, constraints at both levels."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from mbds_xsim.learn.energy_models import Hamiltonian

from .energies import drawn_states, march, no_inputs, random_energy
from .mechanisms import scene_of


@pytest.mark.parametrize(("name", "steps"), [("6pendulum", 10), ("3ladder", 20)])
def test_a_learned_energy_is_kept(name: str, steps: int) -> None:
    """Of fourth order, as the method: what is lost is the integrator's."""
    energy = random_energy(name)
    model = Hamiltonian(energy)
    q, v = drawn_states(energy.mechanics, 3)
    p = model.momentum(v)
    force, torque = no_inputs(energy.mechanics, len(q))

    def rate(state: Tensor) -> Tensor:
        return torch.stack(model.derivative(state[:, 0], state[:, 1], force, torque), dim=1)

    with torch.no_grad():
        before = model.total_energy(q, p)
        speed = energy.kinetic(v).total.abs().max()
        start = torch.stack([q, p], dim=1)
        drifts = []
        for count in (steps, 2 * steps):
            end = march(rate, start, count, 0.05)
            after = model.total_energy(end[:, 0], end[:, 1])
            drifts.append(float((after - before).abs().max()))
    order = math.log2(drifts[0] / drifts[1])
    print(f"{name}: drift {drifts[1] / speed:.1e} of the kinetic energy, order {order:.2f}")
    assert order > 3.7
    assert drifts[1] < 1e-9 * speed


@pytest.mark.parametrize("name", ["6pendulum", "3ladder", "four-bar", "bricard", "linked"])
def test_rates_keep_the_constraints(name: str) -> None:
    """A q̇ = 0 and d/dt (A M⁻¹ p) = 0, whatever the energy and the forces."""
    energy = random_energy(scene_of(name))
    mechanics, model = energy.mechanics, Hamiltonian(energy)
    q, v = drawn_states(mechanics)
    torch.manual_seed(4)
    force, torque = no_inputs(mechanics, len(q))
    push = torch.randn_like(force)
    q_rate, p_rate = model.derivative(q, model.momentum(v), push, torque)
    jacobian = mechanics.jacobian(q)
    assert jacobian.along(q_rate).abs().max() < 1e-10
    bend = mechanics.jacobian_rate(q_rate).along(v)
    rise = jacobian.along(mechanics.mass_inverse @ p_rate)
    assert (bend + rise).abs().max() < 1e-8 * rise.abs().max().clamp(min=1.0)
