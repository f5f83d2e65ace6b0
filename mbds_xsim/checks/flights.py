"""Sums over flights (steps in which nothing meets the ground or a stop), and helpers for NaN."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array, Mask


def summed(values: Array, flights: Mask) -> Array:
    """Sum values from the start of each flight up to each of its steps; NaN outside flights.

    Shape (trajectory, step, component), as the values.
    """
    total = np.cumsum(np.where(flights[..., None], values, 0.0), axis=1)
    steps = np.arange(1, values.shape[1] + 1)
    landed = np.maximum.accumulate(np.where(flights, 0, steps), axis=1)
    padded = np.concatenate([np.zeros_like(total[:, :1]), total], axis=1)
    before = np.take_along_axis(padded, landed[..., None], axis=1)
    return np.where(flights[..., None], total - before, np.nan)


def numbers(values: Array) -> Array:
    """Replace NaN by 0 and infinity by the largest finite number."""
    return values if np.isfinite(values).all() else np.nan_to_num(values)


def usual(values: Array) -> Array:
    """Return the lower median over the known steps, 0 if there are none, (trajectory, 1, …)."""
    # Sorting puts NaN last; numpy's nanmedian takes ten times as long.
    last = np.isfinite(values).sum(axis=1, keepdims=True) - 1
    return numbers(np.take_along_axis(np.sort(values, axis=1), np.maximum(last, 0) // 2, axis=1))
