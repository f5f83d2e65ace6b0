"""What many trajectories together tell of inputs, gravity and masses that one does not.

A wrong model is wrong in all trajectories that it makes. Shares of single trajectories are averaged
by what they are known to, and single steps of all trajectories with one another, so that what a
chaotic motion hides shows in a shard.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.coefficients import SURE, parts_of, steps_of
from mbds_xsim.checks.finding import Record
from mbds_xsim.checks.impact_coefficients import Pool, Shown, shown_of

Array = NDArray[np.float64]

_ENOUGH = 4  # trajectories
_SHARPEST = 1e-4  # standard error; no trajectory counts for more
_HALF = 0.5  # of the inputs of a step, at least, that must be missing
_ERRORS = 6.0  # standard errors


@dataclass(frozen=True, eq=False)
class BalanceEvidence:
    """Of some trajectories, what their balances say."""

    names: tuple[str, ...]
    """Of the parts."""
    errors: tuple[float, ...]
    """Standard errors that are no finding."""
    share: Array
    """Shape (part, trajectory); NaN where too few steps count."""
    error: Array
    missing: Array
    """Of the inputs of each step, shape (trajectory, step)."""
    weight: Array
    """How well that is known, shape (trajectory, step)."""
    impacts: Shown | None
    """What single impacts show; None without contact, or of balls alone."""


def evidence_of(record: Record) -> BalanceEvidence | None:
    """Collect what coefficients found; None where nothing flies, or the method is unknown."""
    if record.method is None or not record.flying().any():
        return None
    parts, steps = parts_of(record), steps_of(record)
    return BalanceEvidence(
        names=tuple(part.name for part in parts),
        errors=tuple(part.errors for part in parts),
        share=np.stack([np.where(part.known, part.share, np.nan) for part in parts]),
        error=np.stack([np.maximum(part.error, _SHARPEST) for part in parts]),
        missing=steps.share,
        weight=np.minimum(steps.inputs, 1.0 / _SHARPEST) ** 2,
        impacts=shown_of(record),
    )


def shared_faults(found: Iterable[BalanceEvidence | None]) -> list[str]:
    """Say in a line each what the trajectories have together that no sound engine has."""
    kept = [each for each in found if each is not None]
    if not kept:
        return []
    share, error = (
        np.concatenate([getattr(each, name) for each in kept], axis=1)
        for name in ("share", "error")
    )
    missing, weight = (
        np.concatenate([getattr(each, name) for each in kept]) for name in ("missing", "weight")
    )
    impacts = [each.impacts for each in kept if each.impacts is not None]
    return [*_of_parts(kept[0], share, error), *_of_steps(missing, weight), *_of_impacts(impacts)]


def _of_parts(parts: BalanceEvidence, share: Array, error: Array) -> Iterator[str]:
    known = np.isfinite(share)
    mean, spread = _mean(np.nan_to_num(share), np.where(known, error**-2, 0.0))
    for k, name in enumerate(parts.names):
        allowed, count = SURE + parts.errors[k] * spread[k], int(known[k].sum())
        if count >= _ENOUGH and abs(mean[k]) > allowed:
            yield (
                f"{name}: off by a share of {abs(mean[k]):.2g} in {count} trajectories, "
                f"allowed {allowed:.2g}"
            )


def _of_steps(missing: Array, weight: Array) -> Iterator[str]:
    mean, spread = _mean(missing.T, weight.T)
    enough = (weight > 1.0).sum(axis=0) >= _ENOUGH
    for step in np.flatnonzero(enough & (mean - _ERRORS * spread > _HALF))[:1]:
        yield f"inputs of step {step}: {mean[step]:.2g} of them are missing in all trajectories"


def _of_impacts(found: list[Shown]) -> Iterator[str]:
    pool = Pool.of(Shown.joined(found)) if found else None
    if pool is not None and max(pool.used) > 1.0:
        yield str(pool)


def _mean(values: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted mean over the last axis, and its standard error, from weights and from scatter."""
    total = np.maximum(weight.sum(axis=-1), 1e-9)
    mean = (weight * values).sum(axis=-1) / total
    scatter = np.sqrt(((weight * (values - mean[..., None])) ** 2).sum(axis=-1)) / total
    return mean, np.maximum(scatter, np.sqrt(1.0 / total))
