"""Small cases: a scene with its exact motion, and solvers of equations in one coordinate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene, Vector

Exact = Callable[[Array], Array]

G = 9.81
NONE: Vector = (0.0, 0.0, 0.0)
_CLOCK = Clock(frame=0.02, steps=50)


@dataclass(frozen=True)
class Case:
    """A scene and the exact motion of its bodies' centres of mass."""

    name: str
    verifies: str
    scene: Scene
    exact: Exact
    """Exact positions [m], shape (frame, body, 3), at times [s], shape (frame,)."""
    exact_orientation: Exact | None = None
    """Exact orientations, shape (frame, body, 4); None if the case is not about them."""


def case_of(
    name: str,
    verifies: str,
    bodies: Sequence[Body],
    exact: Exact,
    *joints: Joint,
    orientation: Exact | None = None,
    length: float = 1.0,
    clock: Clock = _CLOCK,
    **more: Any,
) -> Case:
    """Make a case of bodies connected by joints; `more` are other fields of its scene."""
    scene = Scene(name, tuple(bodies), length, joints=joints, clock=clock, **more)
    return Case(name, verifies, scene, exact, orientation)


def even(name: str, mass: float, moment: float, at: Vector = NONE) -> Body:
    """Make a body with equal moments of inertia about all axes."""
    return Body(name, inertia=Inertia(mass, (moment,) * 3), position=at)


def direction(angle: Array) -> Array:
    """Return the directions at angles [rad] from −z towards x, shape (…, 3)."""
    return np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)


def swing(start: float, stiffness: float, time: Array) -> Array:
    """Solve θ'' = −stiffness · sin θ from rest."""
    return integrate(lambda theta: -stiffness * np.sin(theta), start, 0.0, time)


def integrate(
    acceleration: Callable[[float], float], start: float, rate: float, time: Array
) -> Array:
    """Solve x'' = acceleration(x) in one coordinate, from a start and a rate."""
    return solve(lambda _, y: np.array([y[1], acceleration(y[0])]), [start, rate], time)[0]


def solve(rate: Callable[[float, Array], Array], start: list[float], time: Array) -> Array:
    """Solve y' = rate(t, y) to 1e-12 at times [s], shape (coordinate, frame)."""
    from scipy.integrate import solve_ivp

    span = (0.0, float(time[-1]))
    solution = solve_ivp(rate, span, start, method="DOP853", t_eval=time, rtol=1e-12, atol=1e-13)
    return np.asarray(solution.y)
