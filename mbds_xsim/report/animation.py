"""Motions packed for the viewer in the page: small, and exact where engines nearly agree.

All motions share one *base* (the reference, or the first engine where there is none), in 16 bits
over its box. Each engine is its deviation from the base, in 16 bits on a cubic scale: a deviation
of a micrometre keeps two digits beside one of a metre, so that the viewer can magnify it.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.report.palette import Style


def packed_base(base: Array, low: Array, high: Array) -> str:
    """Pack the common motion (trajectory, frame, point, 3) [m] over the box that holds it."""
    return encoded(65535 * (base - low) / np.where(high > low, high - low, 1.0), "<u2")


def packed_entry(
    name: str, style: Style | None, motion: Array, base: Array, reach: float
) -> dict[str, Any]:
    """Pack a motion as its deviation from the common one; without a style it is that one.

    Args:
        name: By which it is shown.
        style: How it is drawn.
        motion: [m], shape (trajectory, frame, point, 3); NaN from where it ends.
        base: The common motion, of the same shape.
        reach: Largest deviation that is shown [m].
    """
    deviation = motion - base
    with np.errstate(invalid="ignore"):
        seen = (np.abs(deviation) <= reach).all(axis=(-1, -2))
    shown = np.logical_and.accumulate(seen, axis=1)
    scaled = np.cbrt(np.where(shown[..., None, None], deviation, 0.0) / reach)
    return {
        "name": name,
        "colour": None if style is None else style.colour,
        "dashed": style is not None and style.dashed,
        "shown": shown.sum(axis=1).tolist(),
        "deviation": None if style is None else encoded(32767 * scaled, "<i2"),
    }


def encoded(values: Array, kind: str) -> str:
    """Give numbers as base64, rounded where the kind is one of integers."""
    return in_base64((values if kind.endswith("f4") else np.rint(values)).astype(kind))


def in_base64(values: NDArray[Any]) -> str:
    """Give the bytes of numbers as they are."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
