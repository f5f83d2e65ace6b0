"""An impact as MuJoCo's spring and damper, a = −b v − k r, with a given restitution.

MuJoCo has no coefficient of restitution. Its damping is calibrated by following the engine's own
steps: a sphere at speed 1 is let through the ground at many phases of the step, and the damping is
found with which it comes back at e in the mean. Every figure is in steps and impact speeds, so one
calibration holds for all speeds, masses and steps, as long as gravity adds little during an impact.

An impact of a single step needs no calibration, b = (1 + e)/h turns v into −e v at once. But it
settles the normal impulse before friction has any: right only where the two do not mix.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

__all__ = ["ImpactLaw", "impact_law", "rebounds"]

Array = NDArray[np.float64]

# Of the spring that lifts what has come to rest in the ground, k h², where an impact is a single
# step. A rebound gains this share, so it is small.
_LIFT = 1e-5
_PHASES = 400
# A damping of 1 takes the whole velocity in a step.
_STRONGEST = 1.0
_MOST_STEPS = 2000


@dataclass(frozen=True)
class ImpactLaw:
    """Spring and damper of a contact, for a step of 1 and a mass of 1."""

    stiffness: float
    """k h²"""
    damping: float
    """b h"""


@functools.cache
def impact_law(restitution: float, steps: int) -> ImpactLaw:
    """Give the law of an impact that lasts some steps.

    A restitution so small that no damper gives it in so many steps gets an impact of one step.
    """
    if steps > 1:
        stiffness = (math.pi / steps) ** 2

        def excess(damping: float) -> float:
            return float(rebounds(ImpactLaw(stiffness, damping)).mean()) - restitution

        # With too few steps an undamped impact gains speed, hence dampings below 0.
        weakest = -0.5 * math.sqrt(stiffness)
        if excess(_STRONGEST) < 0.0:
            return ImpactLaw(stiffness, float(brentq(excess, weakest, _STRONGEST, xtol=1e-12)))
    return ImpactLaw(_LIFT, 1.0 + restitution)


def rebounds(law: ImpactLaw) -> Array:
    """Speeds after impacts at speed 1 that begin at evenly spread phases of a step."""
    height = -(np.arange(_PHASES) + 0.5) / _PHASES
    speed = np.full(_PHASES, -1.0)
    for _ in range(_MOST_STEPS):
        inside = height < 0.0
        if not inside.any():
            break
        # The ground only pushes; a sphere that it leaves behind goes on alone.
        push = np.maximum(0.0, -law.damping * speed - law.stiffness * height)
        speed = np.where(inside, speed + push, speed)
        height = np.where(inside, height + speed, height)
    return speed
