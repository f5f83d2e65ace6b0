"""End of a scene's unique solution, when a contact sphere first reaches the ground.

Rigid contact at several points, or off the centre of mass, has no unique solution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.scene.state import Failure

TOUCHING = 1e-12
"""Gap between a sphere and the ground that counts as a touch [m]."""


@dataclass(frozen=True)
class FirstImpact(Failure):
    """Impact after which a trajectory is not unique: nothing failed, but no more can be known.

    The frames before are as accurate as any; `frame` is the first one after the impact.
    """

    time: float
    """Time of the impact, located to rounding [s]; 0 if the scene starts in contact."""

    @staticmethod
    def at(frame: int, time: float) -> FirstImpact:
        """Create an impact at a time [s]; `frame` is the first frame after it."""
        reason = (
            f"first impact at {time:.6g} s: what follows has no unique solution in rigid contact"
        )
        return FirstImpact(frame, reason, time)


def resting(height: Array, climb: Array) -> Mask:
    """Whether a scene starts in contact, from heights and their rates, shape (batch, sphere)."""
    return np.asarray(((height <= TOUCHING) & (climb <= TOUCHING)).any(axis=1))


def dips(before: tuple[Array, Array], after: tuple[Array, Array], step: Array) -> Array:
    """Find where in a step the cubics through heights and their rates go down to the ground.

    Args:
        before: Heights [m] and their rates [m/s] at the start of the step, shape (batch, sphere).
        after: Heights and rates at the end of the step.
        step: Length of the step [s], shape (batch,).

    Returns:
        Lowest point of each cubic, as a share of the step, shape (batch, sphere); NaN if it stays
        above the ground. The cubics are accurate to 1e-6 m on any frame of 0.02 s.
    """
    height, slope = before[0], before[1] * step[:, None]
    rise, last = after[0] - height, after[1] * step[:, None]
    square, cube = 3.0 * rise - 2.0 * slope - last, slope + last - 2.0 * rise
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(square**2 - 3.0 * cube * slope)
        # Of the two forms of the minimum, take the one without cancellation.
        place = np.where(square > 0.0, -slope / (square + root), (root - square) / (3.0 * cube))
    inside = (place > 0.0) & (place < 1.0)
    place = np.where(inside, place, 1.0)
    lowest = height + place * (slope + place * (square + place * cube))
    place = np.where(after[0] < lowest, 1.0, place)
    return np.where(np.minimum(lowest, after[0]) <= 0.0, place, np.nan)


def first_touch(height: Callable[[float], float], places: Array) -> float | None:
    """Locate the first zero of a height.

    Args:
        height: Height of the lowest sphere at a share of the step [m].
        places: Shares of the step at which it may be below zero; NaN are left out.

    Returns:
        The share of the step; None if the height stays above zero at all of the places.
    """
    for place in np.sort(places[np.isfinite(places)]).tolist():
        if height(place) <= 0.0:
            if height(0.0) <= 0.0:
                return 0.0
            from scipy.optimize import brentq  # takes long to import

            return float(brentq(height, 0.0, place, xtol=1e-15))
    return None
