"""Do two engines draw from one distribution, where single motions no longer agree?

The two-sample energy distance of Székely & Rizzo (2013, J. Stat. Plan. Inference 143, 1249), of
features of the motion at one instant. Trajectory i of two engines has the same start and
inputs; if they draw from one distribution, the two are exchangeable, trajectory by trajectory, and
so the p-value comes from exchanging them at random.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.agreement import markers_of, particle_error
from mbds_xsim.checks.energy import energy_of
from mbds_xsim.checks.finding import Record
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

Array = NDArray[np.float64]

LEAST_COUNT = 20
"""Trajectories from which on distributions are compared."""
_PERMUTATIONS = 1999
_APART = 0.01  # of the scene's length: below it motions agree by themselves
_CONSTANT = 1e-9  # spread of a feature that says nothing, over its size


@dataclass(frozen=True)
class Separation:
    """How far apart the distributions of two samples are."""

    distance: float
    """Energy distance over its largest possible value: 0 for equal samples, 1 for two points."""
    p_value: float
    """Probability of so large a distance if both are draws of one distribution."""
    count: int
    """Trajectories that both samples have."""


def features(record: Record, frame: int) -> Array:
    """Describe each trajectory at a frame, shape (trajectory, 5); NaN where it is lost.

    Mean position of the particles, or other markers, (x, y, z) and their RMS distance from it over
    the scene's length, and energy over the median energy scale.
    """
    points = markers_of(record.mechanism, record.trajectory)[:, frame]
    middle = points.mean(axis=1, keepdims=True)
    extent = np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=-1), axis=1))
    energy = energy_of(record)
    level = energy.total[:, frame] / np.median(energy.scale)
    length = record.scene.length
    columns = [middle[:, 0] / length, extent[:, None] / length, level[:, None]]
    return np.where(record.finite[:, frame, None], np.concatenate(columns, axis=1), np.nan)


def compare_runs(
    scene: Scene, batch: Batch, runs: Sequence[Trajectory]
) -> dict[tuple[int, int], Separation]:
    """Compare runs of one batch in pairs, at the last frame; keys are their numbers.

    Pairs are left out that have fewer than 20 trajectories in common, or of which most agree to
    1 % of the scene's length to the end, so that there is nothing to ask of distributions.
    """
    if len(batch) < LEAST_COUNT:
        return {}
    mechanism = Mechanism.of(scene)
    told = [features(Record(scene, batch, run), len(run.time) - 1) for run in runs]
    found = {}
    for one, other in itertools.combinations(range(len(runs)), 2):
        error = particle_error(mechanism, runs[one], runs[other])[:, -1]
        known = error[np.isfinite(error)]
        if len(known) >= LEAST_COUNT and np.median(known) > _APART * scene.length:
            comparison = compare(told[one], told[other])
            if comparison is not None:
                found[one, other] = comparison
    return found


def compare(one: Array, other: Array, *, seed: int = 0) -> Separation | None:
    """Compare two paired samples, shapes (trajectory, feature).

    Features count by their spread in both samples together; such as hardly vary are left out. The
    p-value is from 1999 random exchanges, the same for the same seed. None with fewer than 20
    trajectories that both have.
    """
    known = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    count = int(known.sum())
    if count < LEAST_COUNT:
        return None
    pooled = np.concatenate([one[known], other[known]])
    spread = pooled.std(axis=0)
    told = spread > _CONSTANT * np.maximum(1.0, np.abs(pooled).max(axis=0))
    if not told.any():
        return Separation(0.0, 1.0, count)
    scaled = pooled[:, told] / spread[told]
    apart = np.linalg.norm(scaled[:, None] - scaled, axis=-1)
    sides = np.random.default_rng(seed).choice((-1.0, 1.0), size=(_PERMUTATIONS, count))
    sides = np.concatenate([np.ones((1, count)), sides])
    signs = np.concatenate([sides, -sides], axis=1)
    # 2 E|a − b| − E|a − a'| − E|b − b'|, and what it is of 2 E|a − b|.
    distances = -np.sum((signs @ apart) * signs, axis=1) / count**2
    between = 2.0 * apart[:count, count:].mean()
    reached = distances >= distances[0] * (1.0 - 1e-9)
    return Separation(
        distance=float(max(distances[0], 0.0) / between) if between else 0.0,
        p_value=float(reached.mean()),
        count=count,
    )
