"""What a point not yet measured will cost, from the points of its curve that were."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mbds_xsim.study.rows import Row
from mbds_xsim.study.sweep import SPAN, Curve

__all__ = ["cost_of", "left_on", "rollout_cost"]

_START = 1.0
"""Starting a process and judging a motion [s]."""
_REPEATS = 0.3
"""What short rollouts are repeated to [s]."""


def rollout_cost(rows: Sequence[Row], count: int, duration: float) -> float | None:
    """Predict the time of a rollout at a number of steps a frame [s]; None where nothing tells.

    The last two points tell how the cost grows, at most in proportion to the steps. Processor
    time is taken, which does not depend on what else the machine has to do.
    """
    done = [(row.steps_per_frame, float(np.median(row.cpu_s))) for row in rows if row.cpu_s]
    if not done:
        return None
    last, spent = done[-1]
    power = 1.0
    if len(done) > 1:
        before, less = done[-2]
        power = min(1.0, max(0.0, math.log(spent / less) / math.log(last / before)))
    return duration * spent * (count / last) ** power


def cost_of(rollout: float) -> float:
    """Time of a task with such a rollout [s]."""
    return _START + max(_REPEATS, rollout)


def left_on(curve: Curve, rows: Sequence[Row], duration: float, limit: float) -> float:
    """Predict the time of the points of a curve that are still to come [s]."""
    counts = curve.counts[len(rows) :]
    costs = (rollout_cost(rows, count, duration) or 0.0 for count in counts if count <= SPAN)
    return sum(cost_of(cost) for cost in costs if cost <= limit)
