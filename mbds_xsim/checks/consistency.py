"""Do runs at halved steps converge, at the declared order, to the reference?

An accuracy budget lets a wrong model pass as long as it is a little wrong. Here the error of the
method itself is taken out by Richardson extrapolation, so that what is left is the model's.
Roache, Verification and Validation in Computational Science and Engineering, 1998, chapter 5.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.agreement import CHAOS, markers_of
from mbds_xsim.checks.energy import energy_of
from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.engine import Method
from mbds_xsim.errors import InputError
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory

__all__ = ["LEAST_SPAN", "Extrapolation", "consistency", "extrapolate"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FACTOR = 3.0
_SAFETY = 1.25  # Roache's grid convergence index with a confirmed order
_SHORT = 0.5
"""So much below the declared order rounds to it. Of 300 starts of 6pendulum, RK4 at 10 ms has 2
that nowhere come within 0.25 of order 4 in energy; all 300 limits are within 0.7 uncertainties.
"""
_OVER = 0.25
LEAST_SPAN = 10
"""Frames that a stretch must have to be judged by."""


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


def consistency(
    scene: Scene,
    batch: Batch,
    runs: Sequence[Trajectory],
    reference: Trajectory,
    method: Method,
    *,
    growth: Array | None = None,
    resolution: float = 1e-9,
) -> list[Finding]:
    """Compare the limit of runs at steps h, h/2 (and h/4) with the reference.

    Each finding's series is the deviation of the limit over its estimated uncertainty, which
    may reach 3; frames outside the asymptotic range, or of growth 100 and more, are NaN. A
    trajectory without such a range of ten frames has no figure and does not pass: it does not
    converge as the method claims.

    Args:
        scene: What was simulated.
        batch: Its starts and inputs.
        runs: Two or three, each at half the step of the one before. Three are far sharper: they
            show the order, and so how good the extrapolation is.
        reference: The solution that the limit must meet.
        method: Whose order is extrapolated with.
        growth: Sensitivity G, shape (trajectory, frame), if known.
        resolution: Accuracy of the reference and of the engine's arithmetic, over the scene's
            length and over the energy scale; grows with G.

    Returns:
        Findings for positions (particles) and for energy.
    """
    order = method.order_for(scene)
    mechanism = Record(scene, batch, reference).mechanism
    places = [_flat(markers_of(mechanism, run)) for run in (*runs, reference)]
    energies = [energy_of(Record(scene, batch, run)) for run in (*runs, reference)]
    levels = [energy.by_body / energies[-1].scale[:, None, None] for energy in energies]
    shape = places[-1].shape[:2]
    grown = np.ones(shape) if growth is None else np.maximum(1.0, growth[:, : shape[1]])
    frame = scene.clock.frame
    with np.errstate(over="ignore", invalid="ignore"):
        return [
            _compare(name, values, order, scale * resolution * grown, grown < CHAOS, frame)
            for name, values, scale in (
                ("consistency of positions", places, scene.length),
                ("consistency of energy", levels, 1.0),
            )
        ]


def extrapolate(runs: Sequence[Array], order: int, floor: Array) -> Extrapolation:
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

    Raises:
        InputError: There are neither two nor three runs.
    """
    if len(runs) not in (2, 3):
        msg = f"runs: got {len(runs)}, allowed are 2 or 3 (at steps h, h/2 and h/4)"
        raise InputError(msg)
    gain = 2.0**order - 1.0
    moved = [(fine - coarse) / gain for coarse, fine in itertools.pairwise(runs)]
    sizes = [_running(move) for move in moved]
    limit = runs[-1] + moved[-1]
    if len(runs) == 2:
        known = np.isfinite(sizes[0])
        return Extrapolation(limit, sizes[0] + floor, np.full(known.shape, np.nan), known)
    apart = _running(limit - runs[-2] - moved[-2])
    settled = gain * sizes[0] <= floor
    coarse, fine = map(_gathered, moved)
    with np.errstate(divide="ignore", invalid="ignore"):
        observed = np.where(settled, np.nan, np.log2(coarse / fine))
    faster = observed > order + _OVER
    unsure = np.where(faster, sizes[0] / 2.0**order, _SAFETY * apart / 3.0)
    asymptotic = settled | (observed >= order - _SHORT)
    return Extrapolation(limit, unsure + floor, observed, asymptotic)


def _compare(
    name: str, values: list[Array], order: int, floor: Array, predictable: Mask, frame: float
) -> Finding:
    frames = min(value.shape[1] for value in values)
    floor = floor[:, :frames]
    *runs, truth = (value[:, :frames] for value in values)
    found = extrapolate(runs, order, floor)
    judged = _longest(found.asymptotic & predictable[:, :frames])
    deviation = np.sqrt(np.sum((found.limit - truth) ** 2, axis=-1))
    series = np.where(judged, deviation / found.uncertainty, np.nan)
    finding = Finding.of(
        name, "1", series[..., None], budget=_FACTOR, note=f"order {order} declared"
    )
    spans = (_span(judged[k], found.order[k], frame) for k in range(len(series)))
    return dataclasses.replace(finding, where=tuple(spans))


def _flat(points: Array) -> Array:
    """Components whose sum of squares is the mean square over the particles."""
    scaled = points / np.sqrt(points.shape[2])
    return scaled.reshape(*points.shape[:2], -1)


def _running(values: Array) -> Array:
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


def _longest(mask: Mask) -> Mask:
    """Keep each row's longest unbroken stretch, if it is long enough to judge by."""
    kept = np.zeros_like(mask)
    least = min(LEAST_SPAN, mask.shape[1])
    for row, keep in zip(mask, kept, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]])))
        begins, ends = edges[::2], edges[1::2]
        if len(begins):
            best = int(np.argmax(ends - begins))
            if ends[best] - begins[best] >= least:
                keep[begins[best] : ends[best]] = True
    return kept


def _span(judged: Mask, observed: Array, frame: float) -> str:
    frames = np.flatnonzero(judged)
    if not len(frames):
        seen = observed[np.isfinite(observed)]
        typical = f"order {np.median(seen):.2f}" if len(seen) else "no order"
        return f"{typical} observed, nowhere as high as declared"
    return f"judged from {frames[0] * frame:.2f} to {frames[-1] * frame:.2f} s"
