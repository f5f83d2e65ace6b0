"""Explicit Runge–Kutta of order 8 (DOP853) over many states at once, each with its own steps.

Method and error estimate: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I,
1993, section II.10; the coefficients are scipy's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array

Derivative = Callable[[Array], Array]

_SAFETY = 0.9
_SHRINK, _GROW = 0.2, 6.0


def try_step(derivative: Derivative, y: Array, rate: Array, step: Array) -> tuple[Array, Array]:
    """Make one step.

    Args:
        derivative: Time derivative of states.
        y: States, shape (batch, …).
        rate: Their derivatives, the same shape.
        step: [s], shape (batch,).

    Returns:
        The new states, and the derivatives at all stages and at the end, shape (stage, batch, …).
    """
    method = coefficients()
    count = method.n_stages
    stages = np.empty((count + 1, *y.shape))
    flat = stages.reshape(count + 1, -1)
    stages[0] = rate
    h = step.reshape(-1, *[1] * (y.ndim - 1))
    for k in range(1, count):
        stages[k] = derivative(y + h * (method.A[k, :k] @ flat[:k]).reshape(y.shape))
    new = y + h * (method.B @ flat[:count]).reshape(y.shape)
    stages[count] = derivative(new)
    return new, stages


def error_ratio(stages: Array, step: Array, allowed: Array) -> Array:
    """Estimated error of a step over what is allowed, shape (batch,): above 1 is too much."""
    batch, method = stages.shape[1], coefficients()
    flat = stages.reshape(len(stages), -1)
    fifth, third = (
        np.sum(((weights @ flat).reshape(allowed.shape) / allowed).reshape(batch, -1) ** 2, axis=1)
        for weights in (method.E5, method.E3)
    )
    size = allowed[0].size
    combined = np.sqrt((fifth + 0.01 * third) * size)
    return step * fifth / np.where(combined > 0.0, combined, 1.0)


def next_step(step: Array, ratio: Array) -> Array:
    """Step that the error of the last one suggests; a ratio that is not finite shrinks it."""
    with np.errstate(divide="ignore"):
        factor = np.clip(_SAFETY * ratio**-0.125, _SHRINK, _GROW)
    return step * np.where(np.isfinite(ratio), factor, _SHRINK)


@functools.cache
def coefficients() -> Any:
    """Give the class that holds them; it is imported with the first step, as that takes long."""
    from scipy.integrate import DOP853

    return DOP853
