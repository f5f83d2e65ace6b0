"""Masses that can move: what a file gives is taken as it is wherever physics allows it."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array

from .parts import Mass

SHARE = 1e-6
"""Mass and inertia of a part that has none, over those of what it carries."""
_LEAST = 2e-9
"""Smallest second moment that a body is given, over the largest; `Inertia` takes half of it."""
_ROUNDED = 1e-10


def physical(inertia: Array) -> Array | None:
    """Give the nearest inertia that a body can have; None: this is one.

    A body's second moments Σ = ∫ r rᵀ dm, of which I = tr(Σ) 1 − Σ, are not negative along any
    axis: those that are become zero. So each moment of A + B < C grows by half of what lacks.
    """
    values, axes = np.linalg.eigh(np.trace(inertia) / 2 * np.eye(3) - inertia)
    high = values[1] + values[2]
    if values[0] >= -_ROUNDED * high and values[0] + values[1] >= _LEAST / 2 * high:
        return None
    values = np.maximum(values, _LEAST * values[2])
    lifted = (axes * values) @ axes.T
    return np.asarray(np.trace(lifted) * np.eye(3) - lifted)


def small(carried: Mass, com: Array) -> Mass:
    """Give a share of what is carried, alike along all axes, at a point."""
    moment = SHARE * np.trace(carried.inertia) / 3
    return Mass(SHARE * carried.mass, com, moment * np.eye(3))
