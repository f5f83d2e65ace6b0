"""The floor of an ablation: where motions can be compared, and how far engines lie apart there."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks import agreement
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.result import Evidence
from mbds_xsim.scene import Scene
from mbds_xsim.state import Trajectory
from mbds_xsim.study.ablate_result import Floor

__all__ = ["Window", "disagreement", "floor_of", "window_of"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_INSTANT = 1.0
_APART = 0.01  # of the scene's length, as for the agreement time


@dataclass(frozen=True, eq=False)
class Window:
    """Over which frames of each start changes are judged, and how."""

    judged: Mask
    """Shape (start, frame)."""
    weight: Array
    """What changes are divided by, max(1, growth); shape (start, frame)."""
    time: Array
    apart: Array
    """Largest distance of two engines [m], shape (start, frame)."""
    regular: Mask
    """Starts that are judged at 1 s: all but those of the high interval, shape (start,)."""
    ends: str
    """What ends the comparison before the last frame; empty where nothing does."""

    @property
    def spans(self) -> Array:
        """Time over which each start is compared [s], shape (start,)."""
        return np.asarray(self.time[self.judged.sum(axis=1) - 1])

    @property
    def reaches(self) -> bool:
        """Whether any start is compared for 1 s, or all of a shorter scene."""
        return bool(self.spans.max() >= min(_INSTANT, self.time[-1]) * (1 - 1e-9))

    def at_instant(self, error: Array) -> Array:
        """Give errors at 1 s [m] of the regular starts that are judged there, shape (any,)."""
        frame = int(np.argmin(np.abs(self.time - _INSTANT)))
        if abs(self.time[frame] - _INSTANT) > 1e-9:
            return np.zeros(0)
        return np.asarray(error[self.regular & self.judged[:, frame], frame])

    @property
    def frames(self) -> int:
        """Frames that are looked at: all that are judged, and the first second."""
        second = int(np.searchsorted(self.time, _INSTANT * (1 - 1e-9)))
        return min(max(int(self.judged.sum(axis=1).max()), second + 1), len(self.time))

    def beyond(self, error: Array) -> float:
        """Give the errors over the engines' distance at 1 s, whether judged or not: the median."""
        frame = min(int(np.searchsorted(self.time, _INSTANT * (1 - 1e-9))), len(self.time) - 1)
        known = np.isfinite(error[:, frame]) & (self.apart[:, frame] > 0)
        ratio = error[known, frame] / self.apart[known, frame]
        return float(np.median(ratio)) if ratio.size else 0.0

    def weighted(self, error: Array) -> Array:
        """Give the largest weighted error of each start over the judged frames [m], (start,)."""
        return np.asarray(np.nanmax(np.where(self.judged, error / self.weight, 0.0), axis=1))


def window_of(evidence: Evidence, apart: Array) -> Window:
    """Settle where motions can be compared.

    With a reference to the end: as long as disturbances grow less than a hundredfold. Where
    contact leaves no unique solution: until the engines are 1 % of the scene's length apart.
    """
    known = np.isfinite(evidence.reference.position).all(axis=(2, 3))
    growth = np.where(np.isfinite(evidence.growth), evidence.growth, 1.0)
    calm, ends = growth < agreement.CHAOS, "chaos"
    if not known.all():
        calm &= apart <= _APART * evidence.scene.length
        ends = "engines part by 1 % of the length in contact"
    judged = np.logical_and.accumulate(calm, axis=1)
    interval = [evidence.batch.interval(row) for row in range(len(evidence.batch))]
    return Window(
        judged=judged,
        weight=np.maximum(1.0, growth),
        time=evidence.reference.time,
        apart=apart,
        regular=np.array([name != "high" for name in interval]),
        ends="" if judged.all() else ends,
    )


def disagreement(scene: Scene, runs: list[Trajectory]) -> Array:
    """Compute the largest RMS particle distance of two runs [m], shape (start, frame).

    Where a run has ended it no longer counts; 0 where fewer than two are left.
    """
    mechanism = Mechanism.of(scene)
    pairs = [agreement.particle_error(mechanism, *pair) for pair in combinations(runs, 2)]
    if not pairs:
        return np.zeros((len(runs[0]), len(runs[0].time)))
    return np.asarray(np.max(np.nan_to_num(pairs, nan=0.0), axis=0))


def floor_of(scene: Scene, window: Window, apart: Array) -> Floor:
    """Give what a change must exceed."""
    at_one = window.at_instant(apart)
    return Floor(
        disagreement_1s_m=float(at_one.max()) if at_one.size else None,
        disagreement_m=float(window.weighted(apart).max()),
        budget_1s_m=scene.budget.error_1s * scene.length,
        budget_m=scene.budget.error * scene.length,
    )
