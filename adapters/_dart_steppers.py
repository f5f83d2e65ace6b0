"""The ways of stepping a DART model over a frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ._dart_loads import Loads
from ._dart_model import Model

__all__ = ["ForwardDynamicsRK4", "SemiImplicitEuler", "Stepper"]

Array = NDArray[np.float64]

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
# Below it sin(x)/x is 1; squares of smaller numbers vanish.
_TINY = 1e-150


class Stepper(ABC):
    """Moves the skeleton from where it is."""

    call: ClassVar[str]
    """The engine's call of a step; empty where it has none."""

    def __init__(self, model: Model, loads: Loads, step: float) -> None:
        self.model = model
        self.loads = loads
        self.step = step

    @abstractmethod
    def advance(self, step_count: int) -> None:
        """Take steps under the loads that are held."""


class SemiImplicitEuler(Stepper):
    """DART's own `World.step`: velocities first, constraint impulses, then positions."""

    call = "world.step(False)"

    def advance(self, step_count: int) -> None:
        step, loads = self.model.world.step, self.loads
        for _ in range(step_count):
            # As `Loads.apply`, whose call in each step would be felt.
            for push, force in loads.forces:
                push(force)
            for act in loads.others:
                act()
            step(False)


class ForwardDynamicsRK4(Stepper):
    """Classical Runge–Kutta on DART's `computeForwardDynamics`.

    Rotations are advanced on their group: within a step they are the start's times the
    exponential of an increment, which DART's `integratePositions` takes, and commutators make up
    for the increments' turning (Munthe-Kaas 1998, BIT 38, 92, with the commutators reduced as in
    Munthe-Kaas and Owren 1999, Phil. Trans. R. Soc. A 357, 957).
    """

    call = ""

    def __init__(self, model: Model, loads: Loads, step: float) -> None:
        super().__init__(model, loads, step)
        # A ball's increments stand on the right of its rotation, a free body's on the left.
        self._turns = np.concatenate([model.turning_at, model.free_turn_at])
        self._side = np.repeat([1.0, -1.0], [len(model.turning_at), len(model.free_turn_at)])
        count = model.coordinate_count
        self._next, self._after = np.zeros(count, dtype=int), np.zeros(count, dtype=int)
        self._sign = np.zeros(count)
        self._next[self._turns] = np.roll(self._turns, -1, axis=-1)
        self._after[self._turns] = np.roll(self._turns, -2, axis=-1)
        self._sign[self._turns] = self._side[:, None]

    def advance(self, step_count: int) -> None:
        skeleton = self.model.skeleton
        q, u = skeleton.getPositions(), skeleton.getVelocities()
        for _ in range(step_count):
            q, u = self._one(q, u)
        self.model.set_state(q, u)

    def _one(self, q: Array, u: Array) -> tuple[Array, Array]:
        h, rate = self.step, self._acceleration
        a1 = rate(q, np.zeros_like(u), u)
        u2 = u + 0.5 * h * a1
        a2 = rate(q, 0.5 * h * u, u2)
        u3 = u + 0.5 * h * a2
        a3 = rate(q, 0.5 * h * u2 + 0.125 * h * h * self._commutator(u, u2), u3)
        u4 = u + h * a3
        a4 = rate(q, h * u3, u4)
        increment = h / 6.0 * (u + 2.0 * (u2 + u3) + u4)
        increment += h * h / 12.0 * self._commutator(u, u4)
        return self._moved(q, increment), u + h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)

    def _acceleration(self, q: Array, increment: Array, u: Array) -> Array:
        skeleton = self.model.skeleton
        self.model.set_state(q, increment)
        skeleton.integratePositions(1.0)
        skeleton.setVelocities(u)
        self.loads.apply()
        skeleton.computeForwardDynamics()
        return skeleton.getAccelerations()

    def _moved(self, q: Array, increment: Array) -> Array:
        """Move q for good. DART cuts its exponential's series off below 1e-3 rad; this does not."""
        moved = q + increment
        turns = self._turns
        moved[turns] = _composed(q[turns], increment[turns], self._side)
        return moved

    def _commutator(self, a: Array, b: Array) -> Array:
        """a × b of each rotation, positive where increments stand on the right; 0 elsewhere."""
        i, j = self._next, self._after
        return self._sign * (a[i] * b[j] - a[j] * b[i])


def _composed(q: Array, increment: Array, side: Array) -> Array:
    """Rotation vectors of exp(q)·exp(increment), or exp(increment)·exp(q) where side is −1.

    Written out, as it is called once a step; shapes (rotation, 3) and (rotation,).
    """
    count = len(q)
    half = 0.5 * np.concatenate([q, increment])
    angle = np.sqrt(np.einsum("ij,ij->i", half, half))
    half *= (np.sin(angle) / np.maximum(angle, _TINY) + (angle < _TINY))[:, None]
    cosine = np.cos(angle)
    a, b, cos_a, cos_b = half[:count], half[count:], cosine[:count], cosine[count:]
    w = cos_a * cos_b - np.einsum("ij,ij->i", a, b)
    v = cos_a[:, None] * b + cos_b[:, None] * a
    v += side[:, None] * (a[:, _NEXT] * b[:, _AFTER] - a[:, _AFTER] * b[:, _NEXT])
    sine = np.sqrt(np.einsum("ij,ij->i", v, v))
    # Of the quaternions (w, v) and (−w, −v), the one with w ≥ 0 turns by at most π.
    turned = 2.0 * np.copysign(np.arctan2(sine, np.abs(w)), w)
    return v * (turned / np.maximum(sine, _TINY) + 2.0 * (sine < _TINY))[:, None]
