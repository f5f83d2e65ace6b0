"""Physically possible masses: the values of a file are kept wherever physics allows."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array

from .parts import Mass

SHARE = 1e-6
"""Mass and inertia given to a part without any, over those of everything it carries."""
_LEAST = 2e-9
"""Smallest second moment given to a body, over the largest; `Inertia` accepts half this ratio."""
_ROUNDED = 1e-10


def physical(inertia: Array) -> Array | None:
    """Return the nearest inertia that a body can have; None if the given one is possible.

    The second moments Σ = ∫ r rᵀ dm of a body, with I = tr(Σ) 1 − Σ, are never negative: smaller
    ones rise to nearly zero. Where A + B < C, A and B thus each grow by half of C − A − B.
    """
    values, axes = np.linalg.eigh(np.trace(inertia) / 2 * np.eye(3) - inertia)
    high = values[1] + values[2]
    if values[0] >= -_ROUNDED * high and values[0] + values[1] >= _LEAST / 2 * high:
        return None
    values = np.maximum(values, _LEAST * values[2])
    second_moments = (axes * values) @ axes.T
    return np.asarray(np.trace(second_moments) * np.eye(3) - second_moments)


def small(carried: Mass, com: Array, length: float) -> Mass:
    """Return a small share of the carried mass at a point, with an isotropic inertia.

    Args:
        carried: Mass that is carried.
        com: The point [m].
        length: Extent of the model [m], for the inertia if what is carried has none.
    """
    moment = SHARE * (np.trace(carried.inertia) / 3 or SHARE * carried.mass * length**2)
    return Mass(SHARE * carried.mass, com, moment * np.eye(3))
