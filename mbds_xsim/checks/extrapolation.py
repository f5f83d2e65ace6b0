"""Limit of runs at steps h, h/2 and h/4 for a vanishing step, and its uncertainty.

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
"""Least number of frames in a stretch that can be judged."""
OVER = 0.25
"""Excess over the declared order from which on terms of several orders may cancel."""
_SAFETY = 1.25  # Roache's grid convergence index with a confirmed order
SHORT = 0.5
"""Largest shortfall that still rounds to the declared order. Of 300 starts of 6pendulum, RK4 at
10 ms has 2 that never come within 0.25 of order 4 in energy; all 300 limits are within 0.7
uncertainties."""
_IRREGULAR = 1.0  # the same where joints stick or run into stops


@dataclass(frozen=True, eq=False)
class Extrapolation:
    """Limit of some quantities for a vanishing step, and its uncertainty."""

    limit: Array
    """Extrapolated values, shape (trajectory, frame, component)."""
    uncertainty: Array
    """Norm over the components, never falling in time, shape (trajectory, frame)."""
    order: Array
    """Observed order of convergence up to each frame; NaN with two runs, or where the runs agree
    to the resolution; shape (trajectory, frame)."""
    asymptotic: Mask
    """Whether the observed order rounds to the declared one or is higher, so that the uncertainty
    holds, same shape."""


def extrapolate(
    runs: Sequence[Array], order: int, floor: Array, *, bumps: bool = False
) -> Extrapolation:
    """Extrapolate quantities of runs at steps h, h/2 (and h/4) to a vanishing step.

    With three runs there are two extrapolations. Their difference is at least three times the
    error of the finer one, because that error falls at least with the square of the step. Where
    the runs converge faster than declared, terms of several orders may cancel in the finer
    difference; there the coarser correction, divided by 2^order, is the uncertainty.
    With two runs nothing shows how good the extrapolation is, so all of it is uncertain.

    Args:
        runs: Runs of shape (trajectory, frame, component), coarsest first.
        order: Declared order of convergence.
        floor: Differences up to which runs agree to rounding, shape (trajectory, frame).
        bumps: Whether joints stick or run into stops, or servos saturate. The instant of such an
            event within a step changes with the step, so that errors fall irregularly: then the
            finest run is the limit, and the difference between runs is the uncertainty.

    Raises:
        InputError: There are neither two nor three runs.
    """
    if len(runs) not in (2, 3):
        raise InputError(f"runs: got {len(runs)}, allowed are 2 or 3 (at steps h, h/2 and h/4)")
    gain = 2.0**order - 1.0
    corrections = [(fine - coarse) / gain for coarse, fine in itertools.pairwise(runs)]
    sizes = [running(correction) for correction in corrections]
    limit = runs[-1] + corrections[-1]
    if len(runs) == 2:
        known = np.isfinite(sizes[0])
        return Extrapolation(limit, sizes[0] + floor, np.full(known.shape, np.nan), known)
    difference = running(limit - runs[-2] - corrections[-2])
    settled = gain * sizes[0] <= floor
    coarse, fine = map(_gathered, corrections)
    with np.errstate(divide="ignore", invalid="ignore"):
        observed = np.where(settled, np.nan, np.log2(coarse / fine))
    faster = observed > order + OVER
    uncertainty = np.where(faster, sizes[0] / 2.0**order, _SAFETY * difference / 3.0)
    asymptotic = settled | (observed >= order - SHORT)
    if bumps:
        uncertainty = np.maximum(0.5 * gain * sizes[0], gain * sizes[1])
        # An impact just before a frame shows in velocities there, in positions at the next.
        limit, uncertainty[:, :-1] = runs[-1], np.fmax(uncertainty[:, :-1], uncertainty[:, 1:])
        asymptotic = settled | (observed >= order - _IRREGULAR)
    return Extrapolation(limit, uncertainty + floor, observed, asymptotic)


def running(values: Array) -> Array:
    """Return the largest norm up to each frame, so that errors passing through zero still count."""
    return _shared(np.maximum.accumulate(np.sqrt(np.sum(values**2, axis=-1)), axis=1))


def _gathered(values: Array) -> Array:
    """Return the norm of all values up to each frame, which grows more smoothly than `running`."""
    return _shared(np.sqrt(np.cumsum(np.sum(values**2, axis=-1), axis=1)))


def _shared(grown: Array) -> Array:
    """Set the first frames, too few to be typical, to the value at the last of them."""
    first = min(LEAST_SPAN, grown.shape[1])
    grown[:, :first] = grown[:, first - 1 : first]
    return np.asarray(grown)
