"""LGNN's closed-form mass matrix beside Hessians by automatic differentiation.

python -m benchmarks.lagrangian_speed [--batch N] [--rounds N] > reports/lagrangian-speed.md

Both give the same accelerations of the same learned Lagrangian, with gradients for training. The
generic way differentiates L twice and the constraints twice, as the published code does, here with
Cholesky's factors instead of its pseudo-inverses, which would only slow it down. One thread,
interleaved, the median counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import print_head, print_made, print_table, take_turns, wall_s
from mbds_xsim.learn.energy import EnergyNetwork, EnergyShape
from mbds_xsim.learn.energy_models import Lagrangian
from mbds_xsim.learn.mechanics import Mechanics, constrained
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.registry import load_scene

AIM = {"6pendulum": 5, "3ladder": 15}
_COMMAND = "python -m benchmarks.lagrangian_speed > reports/lagrangian-speed.md"
_TEXT = """\
Milliseconds of a step of training of LGNN (accelerations of a batch and their gradient), one
thread: by the closed form, and by Hessians from automatic differentiation of the same learned
Lagrangian. They take turns, medians. *Apart*: largest difference of their accelerations, relative.
"""


def states(mechanics: Mechanics, count: int) -> tuple[Tensor, Tensor]:
    batch = draw_batch(mechanics.mechanism.scene, range(count), noise=False)
    native = mechanics.mechanism.native_rotation(batch.orientation)
    return (
        torch.as_tensor(mechanics.points.place(batch.position, native)),
        torch.as_tensor(mechanics.points.move(native, batch.velocity, batch.angular_velocity)),
    )


def by_autodiff(energy: EnergyNetwork) -> Callable[[Tensor, Tensor], Tensor]:
    mechanics = energy.mechanics

    def lagrangian(q: Tensor, v: Tensor) -> Tensor:
        x, y = q.view(1, -1, 3), v.view(1, -1, 3)
        return (energy.kinetic(y).total - energy.potential(x))[0]

    def residual(q: Tensor) -> Tensor:
        return mechanics.residual(q.view(1, -1, 3))[0]

    def terms(q: Tensor, v: Tensor) -> tuple[Tensor, ...]:
        func = torch.func
        mass = func.hessian(lagrangian, 1)(q, v)
        mixed = func.jacfwd(func.grad(lagrangian, 1), 0)(q, v)
        jacobian = func.jacfwd(residual)
        bias = func.jvp(lambda at: jacobian(at) @ v, (q,), (v,))[1]
        return mass, func.grad(lagrangian)(q, v) - mixed @ v, jacobian(q), bias

    def acceleration(q: Tensor, v: Tensor) -> Tensor:
        mass, load, jacobian, bias = torch.vmap(terms)(q.flatten(1), v.flatten(1))
        return constrained(mass, load, jacobian, bias).view_as(q)

    return acceleration


def in_closed_form(energy: EnergyNetwork, count: int) -> Callable[[Tensor, Tensor], Tensor]:
    model, mechanism = Lagrangian(energy), energy.mechanics.mechanism
    force = torch.zeros(count, mechanism.body_count, 3, dtype=torch.float64)
    torque = torch.zeros(count, len(mechanism.hinges), dtype=torch.float64)
    return lambda q, v: model.acceleration(q, v, force, torque)


def descend(energy: EnergyNetwork, ask: Callable[[], Tensor]) -> None:
    energy.zero_grad()
    (ask() ** 2).mean().backward()  # type: ignore[no-untyped-call]


def twice_s(work: Callable[[], object]) -> float:
    """Time of the second; the first finds the memory that the other way has left to it [s]."""
    work()
    return wall_s(work)


def compare(name: str, count: int, rounds: int) -> list[str]:
    torch.manual_seed(0)
    energy = EnergyNetwork(Mechanics(load_scene(name)), EnergyShape()).double()
    q, v = states(energy.mechanics, count)
    closed, generic = in_closed_form(energy, count), by_autodiff(energy)
    one, two = closed(q, v).detach(), generic(q, v).detach()
    off = float((one - two).abs().max() / two.abs().max())
    works = [
        lambda: descend(energy, lambda: closed(q, v)),
        lambda: descend(energy, lambda: generic(q, v)),
    ]
    fast, slow = np.median(take_turns(works, (rounds, rounds), spent=twice_s), axis=0)
    millis = (f"{1e3 * seconds:.1f}" for seconds in (fast, slow))
    return [name, str(count), *millis, f"{slow / fast:.1f}", str(AIM[name]), f"{off:.0e}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print_head("What the closed form of a Lagrangian's mass matrix saves", _COMMAND, _TEXT)
    rows = (compare(name, arguments.batch, arguments.rounds) for name in AIM)
    print_table("scene|>batch|>closed form|>automatic|>ratio|>aim|>apart", rows)
    print_made(f"torch {torch.__version__}")


if __name__ == "__main__":
    main()
