"""Runge–Kutta on coordinates that include rotations, for engines that give accelerations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mbds_xsim.base.arrays import Array, Index


class TurningRK4:
    """Classical fourth-order Runge–Kutta, with rotations advanced on their group.

    Within a step, a rotation is that at the start times the exponential of an increment, and
    commutators correct for the turning of the increments (Munthe-Kaas 1998, BIT 38, 92, with the
    commutators reduced as in Munthe-Kaas and Owren 1999, Phil. Trans. R. Soc. A 357, 957).

    Args:
        count: Number of velocity coordinates.
        turns: Indices of the three that are each rotation's angular velocity, shape (rotation, 3).
        side: 1 if a rotation's increments stand on the right of it, in its own axes, and −1 if
            they stand on the left, shape (rotation,).
    """

    def __init__(self, count: int, turns: Index, side: Array) -> None:
        self._next, self._after = np.zeros(count, dtype=int), np.zeros(count, dtype=int)
        self._sign = np.zeros(count)
        self._next[turns] = np.roll(turns, -1, axis=-1)
        self._after[turns] = np.roll(turns, -2, axis=-1)
        self._sign[turns] = side[:, None]

    def step(
        self,
        h: float,
        q: Array,
        u: Array,
        rate: Callable[[Array, Array, Array], Array],
        moved: Callable[[Array, Array], Array],
    ) -> tuple[Array, Array]:
        """Take a step.

        Args:
            h: Length of the step [s].
            q: Coordinates, shape (…, coordinate).
            u: Their velocities, shape (…, velocity coordinate).
            rate: Function that returns the accelerations at coordinates moved by an increment, and
                at velocities.
            moved: Function that moves coordinates by an increment.
        """
        a1 = rate(q, np.zeros_like(u), u)
        u2 = u + 0.5 * h * a1
        a2 = rate(q, 0.5 * h * u, u2)
        u3 = u + 0.5 * h * a2
        a3 = rate(q, 0.5 * h * u2 + 0.125 * h * h * self._commutator(u, u2), u3)
        u4 = u + h * a3
        a4 = rate(q, h * u3, u4)
        increment = h / 6.0 * (u + 2.0 * (u2 + u3) + u4)
        increment += h * h / 12.0 * self._commutator(u, u4)
        return moved(q, increment), u + h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)

    def _commutator(self, a: Array, b: Array) -> Array:
        """Return a × b of each rotation, −a × b if increments stand on the left; 0 elsewhere."""
        i, j = self._next, self._after
        return self._sign * (a[..., i] * b[..., j] - a[..., j] * b[..., i])
