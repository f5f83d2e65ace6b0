"""How far motions of one scene lie apart: from the reference, and from each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.scene.markers import marker_positions
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.state import Trajectory

Array = NDArray[np.float64]

CHAOS = 100.0
"""Growth of a perturbation from which on disagreement is no longer judged."""

_DISAGREEMENT = 0.01  # of the scene's length
_APART = 3.0


def markers_of(mechanism: Mechanism, trajectory: Trajectory) -> Array:
    """Give the points by which motions are compared [m], shape (trajectory, frame, marker, 3)."""
    native = mechanism.native_rotation(trajectory.orientation)
    return marker_positions(mechanism, trajectory.position, native)


def particle_error(mechanism: Mechanism, trajectory: Trajectory, reference: Trajectory) -> Array:
    """Compute the RMS over particles (markers) of their distance [m], (trajectory, frame).

    Where one of the two ends early its frames are left out; NaN frames stay NaN.
    """
    frames = min(len(trajectory.time), len(reference.time))
    apart = (
        (markers_of(mechanism, trajectory)[:, :frames])
        - (markers_of(mechanism, reference)[:, :frames])
    )
    return np.sqrt(np.mean(np.sum(apart**2, axis=-1), axis=-1))


def error_at(error: Array, time: Array, instant: float) -> Array:
    """Give the error at the last frame not after an instant [m], shape (trajectory,)."""
    frame = int(np.searchsorted(time, instant * (1 + 1e-9), side="right")) - 1
    return error[:, max(frame, 0)]


def agreement_time(error: Array, time: Array, length: float) -> Array:
    """Find when the error first passes 1 % of the scene's length [s], shape (trajectory,).

    Infinite where it never does. A frame that was lost disagrees.
    """
    apart = ~(error <= _DISAGREEMENT * length)
    first = time[: error.shape[1]][apart.argmax(axis=1)]
    return np.where(apart.any(axis=1), first, np.inf)


def growth_weighted(error: Array, growth: Array) -> Array:
    """Find the largest error / max(1, G) over the times with growth G < 100 [m].

    Shape (trajectory,). Disagreement that G explains is chaos; past G = 100 nothing is judged,
    since dividing by a huge G would let a frozen mechanism pass. A trajectory that was lost
    while it was still predictable has the figure ∞.
    """
    frames = min(error.shape[1], growth.shape[1])
    predictable = growth[:, :frames] < CHAOS
    weighted = error[:, :frames] / np.maximum(1.0, growth[:, :frames])
    weighted = np.where(np.isfinite(weighted), weighted, np.inf)
    return np.asarray(np.where(predictable, weighted, 0.0).max(axis=1))


def pairwise(mechanism: Mechanism, runs: Sequence[Trajectory], instant: float = 1.0) -> Array:
    """Compute the RMS particle distance at an instant, worst over the trajectories [m].

    Shape (run, run), symmetric with zeros on the diagonal; NaN where either run was lost.
    """
    matrix = np.zeros((len(runs), len(runs)))
    for i, one in enumerate(runs):
        for j, other in enumerate(runs[:i]):
            error = error_at(particle_error(mechanism, one, other), one.time, instant)
            matrix[i, j] = matrix[j, i] = error.max()
    return matrix


def odd_one_out(
    matrix: Array, families: Sequence[str], *, tolerance: float = 0.0
) -> tuple[int, ...]:
    """Name what stands apart from all method families while these agree without it.

    Runs of one family are one vote, since their agreement is no evidence: a run is confirmed by
    its nearest run of another family. The odd one is the run, or the family of runs, whose
    distance to every other family is above the tolerance and more than three times the largest
    distance at which the others, left to themselves, confirm each other. At least two other
    families must be left to do so.

    Args:
        matrix: Distances, shape (run, run); NaN where a run was lost, which is then no vote.
        families: Family of each run.
        tolerance: Distances up to this are agreement [as the matrix].

    Returns:
        The run, or all runs of the odd family; empty where none stands apart or it is open
        which one does.
    """
    present = [k for k in range(len(families)) if np.isfinite(np.delete(matrix[k], k)).any()]
    groups = [[k for k in present if families[k] == family] for family in dict.fromkeys(families)]
    candidates = [[k] for k in present] + [group for group in groups if len(group) > 1]
    odd: dict[tuple[int, ...], float] = {}
    for candidate in candidates:
        rest = [k for k in present if k not in candidate]
        if len({families[k] for k in rest} - {families[candidate[0]]}) < 2:
            continue
        apart = min(_confirmation(matrix, families, k, rest) for k in candidate)
        agreed = max(_confirmation(matrix, families, k, rest) for k in rest)
        if apart > max(tolerance, _APART * agreed):
            odd[tuple(candidate)] = apart / max(agreed, np.finfo(float).tiny)
    if not odd:
        return ()
    # A family is odd as a whole only where none of its runs is odd by itself.
    return max(odd, key=lambda candidate: (-len(candidate), odd[candidate]))


def _confirmation(matrix: Array, families: Sequence[str], run: int, rest: list[int]) -> float:
    """Distance to the nearest run of another family."""
    others = [k for k in rest if families[k] != families[run]]
    distances = [matrix[run, k] for k in others if np.isfinite(matrix[run, k])]
    return float(min(distances, default=np.inf))
