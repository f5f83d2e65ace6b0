"""HGNN: constraints at both levels; test_lgnn.py has its energy along a rollout."""

from __future__ import annotations

import pytest
import torch

from mbds_xsim.learn.energy_models import Hamiltonian
from mbds_xsim.learn.window import KnownInputs

from .energies import drawn_states, no_inputs, random_energy
from .mechanisms import scene_of


@pytest.mark.parametrize("name", ["6pendulum", "3ladder", "four-bar", "bricard", "linked"])
def test_rates_keep_the_constraints(name: str) -> None:
    """Rates keep A q̇ = 0 and d/dt (A M⁻¹ p) = 0, whatever the energy and the forces."""
    energy = random_energy(scene_of(name))
    mechanics, model = energy.mechanics, Hamiltonian(energy)
    q, v = drawn_states(mechanics)
    torch.manual_seed(4)
    force, torque = no_inputs(mechanics, len(q))
    push = torch.randn_like(force)
    q_rate, p_rate = model.derivative(q, model.conjugate(v), KnownInputs(push, torque))
    jacobian = mechanics.jacobian(q)
    assert jacobian.along(q_rate).abs().max() < 1e-10
    bend = mechanics.jacobian_rate(q_rate).along(v)
    rise = jacobian.along(mechanics.mass_inverse @ p_rate)
    assert (bend + rise).abs().max() < 1e-8 * rise.abs().max().clamp(min=1.0)
