"""Explicit Runge–Kutta of order 8 (DOP853) over many states at once, each with its own steps.

Method and error estimate: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I,
1993, section II.10; the coefficients are scipy's.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853

Array = NDArray[np.float64]
Derivative = Callable[[Array], Array]

_A: Array = DOP853.A
_B: Array = DOP853.B
_E3: Array = DOP853.E3
_E5: Array = DOP853.E5
_STAGES: int = DOP853.n_stages
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
    stages = np.empty((_STAGES + 1, *y.shape))
    flat = stages.reshape(_STAGES + 1, -1)
    stages[0] = rate
    h = step.reshape(-1, *[1] * (y.ndim - 1))
    for k in range(1, _STAGES):
        stages[k] = derivative(y + h * (_A[k, :k] @ flat[:k]).reshape(y.shape))
    new = y + h * (_B @ flat[:_STAGES]).reshape(y.shape)
    stages[_STAGES] = derivative(new)
    return new, stages


def error_ratio(stages: Array, step: Array, allowed: Array) -> Array:
    """Estimated error of a step over what is allowed, shape (batch,): above 1 is too much."""
    batch = stages.shape[1]
    flat = stages.reshape(_STAGES + 1, -1)
    fifth, third = (
        np.sum(((weights @ flat).reshape(allowed.shape) / allowed).reshape(batch, -1) ** 2, axis=1)
        for weights in (_E5, _E3)
    )
    size = allowed[0].size
    combined = np.sqrt((fifth + 0.01 * third) * size)
    return step * fifth / np.where(combined > 0.0, combined, 1.0)


def next_step(step: Array, ratio: Array) -> Array:
    """Step that the error of the last one suggests; a ratio that is not finite shrinks it."""
    with np.errstate(divide="ignore"):
        factor = np.clip(_SAFETY * ratio**-0.125, _SHRINK, _GROW)
    return step * np.where(np.isfinite(ratio), factor, _SHRINK)
