"""Steps that divide a frame."""

from __future__ import annotations

import math

_REFINABLE = 4
# What would need shorter steps is too dear for a preset: 20 000 a frame of 20 ms [s].
_SHORTEST = 1e-6


def nearest_step(frame: float, usual: float) -> float:
    """Divide a frame [s] into equal steps as near as can be to a usual one [s]."""
    return frame / max(1, round(frame / usual))


def careful_step(frame: float, longest: float, fewest: int) -> float:
    """Divide a frame [s] into `fewest` steps or more, none above the longest [s].

    A longest step below 1 µs counts as 1 µs. A frame resolves the motion, so mechanisms faster
    than the longest step foresees get finer steps. There are a multiple of four, which the
    consistency check can make coarser.
    """
    count = max(fewest, math.ceil(frame / max(longest, _SHORTEST) - 1e-9))
    return frame / (_REFINABLE * math.ceil(count / _REFINABLE))
