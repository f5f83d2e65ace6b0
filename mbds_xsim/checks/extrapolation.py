"""What runs at steps h, h/2 and h/4 tend to as the step vanishes, and how well that is known.

Roache, Verification and Validation in Computational Science and Engineering, 1998, chapter 5.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.base.errors import InputError

LEAST_SPAN = 10
"""Frames that a stretch must have to be judged by."""
OVER = 0.25
"""So much above the declared order several terms may cancel."""
_SAFETY = 1.25  # Roache's grid convergence index with a confirmed order
SHORT = 0.5
"""So much below the declared order rounds to it. Of 300 starts of 6pendulum, RK4 at 10 ms has 2
that nowhere come within 0.25 of order 4 in energy; all 300 limits are within 0.7 uncertainties.
"""
_IRREGULAR = 1.0  # the same where joints stick or run into stops


@dataclass(frozen=True, eq=False)
class Extrapolation:
    """The limit of vanishing step of some quantities, and how well it is known."""

    limit: Array
    """Shape (trajectory, frame, component)."""
    uncertainty: Array
    """RMS over the components, never falling in time, shape (trajectory, frame)."""
    order: Array
    """Observed order of convergence up to each frame; NaN with two runs, or where the runs agree
    to the resolution; shape (trajectory, frame)."""
    asymptotic: Mask
    """Where the observed order rounds to the declared one or is higher, so that the uncertainty
    holds, same shape."""


def extrapolate(
    runs: Sequence[Array], order: int, floor: Array, *, bumps: bool = False
) -> Extrapolation:
    """Extrapolate quantities of runs at steps h, h/2 (and h/4) to a vanishing step.

    With three runs there are two extrapolations. Their difference is at least three times the
    error of the finer one, because what the extrapolation leaves falls at least with the square
    of the step. Where the runs converge faster than declared, terms of several orders may cancel
    in the finer difference; what the coarser one gives at the declared order is taken for
    uncertain. With two runs nothing tells how good the extrapolation is, and all that it moves is.

    Args:
        runs: Shape (trajectory, frame, component) each, coarsest first.
        order: Declared order of convergence.
        floor: Differences up to this are rounding, shape (trajectory, frame).
        bumps: Whether joints stick or run into stops, or servos saturate. Where in a step they do
            changes with the step, so that errors fall with it in no regular way: the finest run is
            the limit, and what the runs differ by is uncertain.

    Raises:
        InputError: There are neither two nor three runs.
    """
    if len(runs) not in (2, 3):
        msg = f"runs: got {len(runs)}, allowed are 2 or 3 (at steps h, h/2 and h/4)"
        raise InputError(msg)
    gain = 2.0**order - 1.0
    moved = [(fine - coarse) / gain for coarse, fine in itertools.pairwise(runs)]
    sizes = [running(move) for move in moved]
    limit = runs[-1] + moved[-1]
    if len(runs) == 2:
        known = np.isfinite(sizes[0])
        return Extrapolation(limit, sizes[0] + floor, np.full(known.shape, np.nan), known)
    apart = running(limit - runs[-2] - moved[-2])
    settled = gain * sizes[0] <= floor
    coarse, fine = map(_gathered, moved)
    with np.errstate(divide="ignore", invalid="ignore"):
        observed = np.where(settled, np.nan, np.log2(coarse / fine))
    faster = observed > order + OVER
    unsure = np.where(faster, sizes[0] / 2.0**order, _SAFETY * apart / 3.0)
    asymptotic = settled | (observed >= order - SHORT)
    if bumps:
        unsure = np.maximum(0.5 * gain * sizes[0], gain * sizes[1])
        # An impact just before a frame is in the velocities there, and in places at the next.
        limit, unsure[:, :-1] = runs[-1], np.fmax(unsure[:, :-1], unsure[:, 1:])
        asymptotic = settled | (observed >= order - _IRREGULAR)
    return Extrapolation(limit, unsure + floor, observed, asymptotic)


def running(values: Array) -> Array:
    """Largest norm up to each frame: an error that passes through zero is still known."""
    return _shared(np.maximum.accumulate(np.sqrt(np.sum(values**2, axis=-1)), axis=1))


def _gathered(values: Array) -> Array:
    """Norm of all values up to each frame; unlike the largest one it grows smoothly."""
    return _shared(np.sqrt(np.cumsum(np.sum(values**2, axis=-1), axis=1)))


def _shared(grown: Array) -> Array:
    """Let the first frames, of which none may be typical, take what all of them come to."""
    first = min(LEAST_SPAN, grown.shape[1])
    grown[:, :first] = grown[:, first - 1 : first]
    return np.asarray(grown)
