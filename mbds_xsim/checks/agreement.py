"""Distances of motions of one scene from the reference and from each other."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.conservation import energy_of
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.markers import marker_positions
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

CHAOS = 100.0
"""Growth of a perturbation from which on disagreement is no longer judged."""

_DISAGREEMENT = 0.01  # share of the scene's length
_APART = 3.0
LEAST_COUNT = 20
"""Least number of trajectories for comparing distributions."""
_PERMUTATIONS = 1999
_DIVERGED = 0.01  # share of the scene's length; below it motions agree without statistics
_CONSTANT = 1e-9  # spread over size, below which a feature is constant


def markers_of(mechanism: Mechanism, trajectory: Trajectory) -> Array:
    """Return the points by which motions are compared [m], shape (trajectory, frame, marker, 3)."""
    native = mechanism.native_rotation(trajectory.orientation)
    return marker_positions(mechanism, trajectory.position, native)


def particle_error(mechanism: Mechanism, trajectory: Trajectory, reference: Trajectory) -> Array:
    """Compute the RMS over particles (markers) of their distance [m], (trajectory, frame).

    Frames that only one of the two has are left out; NaN frames stay NaN.
    """
    frames = min(len(trajectory.time), len(reference.time))
    ours, theirs = (markers_of(mechanism, run)[:, :frames] for run in (trajectory, reference))
    offset = ours - theirs
    return np.sqrt(np.mean(np.sum(offset**2, axis=-1), axis=-1))


def second(frame: float) -> int:
    """Return the number of the frame that stands for 1 s: the nearest, but never the start.

    It is the earlier of two that are equally near, be `frame` rounded up or down. A scene may end
    before it. `frame` is the interval between frames [s].
    """
    return max(1, round((1.0 - 1e-9) / frame))


def agreement_time(error: Array, time: Array, length: float) -> Array:
    """Find when the error first passes 1 % of the scene's length [s], shape (trajectory,).

    Infinite if it never does. A lost frame counts as disagreement.
    """
    disagrees = ~(error <= _DISAGREEMENT * length)
    first = time[: error.shape[1]][disagrees.argmax(axis=1)]
    return np.where(disagrees.any(axis=1), first, np.inf)


def growth_weighted(error: Array, growth: Array) -> Array:
    """Find the largest error / max(1, G) over the times with growth G < 100 [m].

    Shape (trajectory,). Disagreement that G explains is chaos; past G = 100 nothing is judged,
    since dividing by a huge G would let a frozen mechanism pass. A trajectory that was lost
    while it was still predictable has figure ∞.
    """
    frames = min(error.shape[1], growth.shape[1])
    predictable = growth[:, :frames] < CHAOS
    weighted = error[:, :frames] / np.maximum(1.0, growth[:, :frames])
    weighted = np.where(np.isfinite(weighted), weighted, np.inf)
    return np.asarray(np.where(predictable, weighted, 0.0).max(axis=1))


def pairwise(mechanism: Mechanism, runs: Sequence[Trajectory], frame: int) -> Array:
    """Compute the RMS particle distance at a frame, worst over the trajectories [m].

    Shape (run, run), symmetric with zeros on the diagonal; NaN where either run was lost.
    """
    matrix = np.zeros((len(runs), len(runs)))
    for i, one in enumerate(runs):
        for j, other in enumerate(runs[:i]):
            error = particle_error(mechanism, one, other)
            matrix[i, j] = matrix[j, i] = error[:, frame].max()
    return matrix


def odd_one_out(
    matrix: Array, families: Sequence[str], *, tolerance: float = 0.0
) -> tuple[int, ...]:
    """Find the run or family that stands apart while all other families agree without it.

    Runs of one family have one vote, since their agreement is no evidence: a run is confirmed by
    its nearest run of another family. A run, or family of runs, is odd if its distance to every
    other family is above the tolerance and more than three times the largest distance at which
    the others confirm each other without it. At least two other families must be left.

    Args:
        matrix: Distances, shape (run, run); NaN where a run was lost, which then has no vote.
        families: Family of each run.
        tolerance: Distances up to this are agreement [as the matrix].

    Returns:
        The odd run, or all runs of the odd family; empty if none stands apart or too few
        families are left to decide.
    """
    present = [k for k in range(len(families)) if np.isfinite(np.delete(matrix[k], k)).any()]
    groups = [[k for k in present if families[k] == family] for family in dict.fromkeys(families)]
    candidates = [[k] for k in present] + [group for group in groups if len(group) > 1]
    odd: dict[tuple[int, ...], float] = {}
    for candidate in candidates:
        rest = [k for k in present if k not in candidate]
        if len({families[k] for k in rest} - {families[candidate[0]]}) < 2:
            continue
        distance = min(_confirmation(matrix, families, k, rest) for k in candidate)
        spread = max(_confirmation(matrix, families, k, rest) for k in rest)
        if distance > max(tolerance, _APART * spread):
            odd[tuple(candidate)] = distance / max(spread, np.finfo(float).tiny)
    if not odd:
        return ()
    # A family is odd as a whole only where none of its runs is odd by itself.
    return max(odd, key=lambda candidate: (-len(candidate), odd[candidate]))


def _confirmation(matrix: Array, families: Sequence[str], run: int, rest: list[int]) -> float:
    """Return the distance to the nearest run of another family, ∞ without one."""
    others = [k for k in rest if families[k] != families[run]]
    distances = [matrix[run, k] for k in others if np.isfinite(matrix[run, k])]
    return float(min(distances, default=np.inf))


@dataclass(frozen=True)
class Separation:
    """Distance between the distributions of two samples, and its significance."""

    distance: float
    """Energy distance over its largest possible value: 0 for equal samples, 1 for two points."""
    p_value: float
    """Probability of a distance at least as large if both samples have one distribution."""
    count: int
    """Number of trajectories that are known in both samples."""


def features(record: Record, frame: int) -> Array:
    """Describe each trajectory at a frame, shape (trajectory, 5); NaN where it is lost.

    Features are the mean position (x, y, z) of the markers (particles if there are any) and their
    RMS distance from it, over the scene's length, and the energy over the median energy scale.
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
    """Compare runs of one batch in pairs at the last frame; keys are pairs of run indices.

    Pairs with fewer than 20 common trajectories are left out. So are pairs of which most
    trajectories agree to 1 % of the scene's length at the end: there is nothing to compare.
    """
    if len(batch) < LEAST_COUNT:
        return {}
    mechanism = Mechanism.of(scene)
    samples = [features(Record(scene, batch, run), len(run.time) - 1) for run in runs]
    separations = {}
    for one, other in itertools.combinations(range(len(runs)), 2):
        error = particle_error(mechanism, runs[one], runs[other])[:, -1]
        known = error[np.isfinite(error)]
        if len(known) >= LEAST_COUNT and np.median(known) > _DIVERGED * scene.length:
            separation = compare(samples[one], samples[other])
            if separation is not None:
                separations[one, other] = separation
    return separations


def compare(one: Array, other: Array, *, seed: int = 0) -> Separation | None:
    """Compare two paired samples, shapes (trajectory, feature), by their energy distance.

    It is the two-sample distance of Székely & Rizzo (2013, J. Stat. Plan. Inference 143, 1249).
    Trajectory i of two engines has the same start and inputs. If both draw from one distribution,
    the two are exchangeable, trajectory by trajectory, so the p-value comes from exchanging
    them at random.

    Features are scaled by their spread in both samples together; those that hardly vary are left
    out. The p-value is from 1999 random exchanges, the same for the same seed. None with fewer than
    20 common trajectories.
    """
    known = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    count = int(known.sum())
    if count < LEAST_COUNT:
        return None
    pooled = np.concatenate([one[known], other[known]])
    spread = pooled.std(axis=0)
    varies = spread > _CONSTANT * np.maximum(1.0, np.abs(pooled).max(axis=0))
    if not varies.any():
        return Separation(0.0, 1.0, count)
    scaled = pooled[:, varies] / spread[varies]
    matrix = np.linalg.norm(scaled[:, None] - scaled, axis=-1)
    sides = np.random.default_rng(seed).choice((-1.0, 1.0), size=(_PERMUTATIONS, count))
    sides = np.concatenate([np.ones((1, count)), sides])
    signs = np.concatenate([sides, -sides], axis=1)
    # 2 E|a − b| − E|a − a'| − E|b − b'|, and its share of 2 E|a − b|.
    distances = -np.sum((signs @ matrix) * signs, axis=1) / count**2
    between = 2.0 * matrix[:count, count:].mean()
    reached = distances >= distances[0] * (1.0 - 1e-9)
    return Separation(
        distance=float(max(distances[0], 0.0) / between) if between else 0.0,
        p_value=float(reached.mean()),
        count=count,
    )
