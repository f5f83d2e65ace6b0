"""Windows of consecutive frames, drawn at random as training does."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.errors import InputError

if TYPE_CHECKING:
    from mbds_xsim.dataset.series import Series

__all__ = ["Windows"]

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Windows:
    """All windows of some trajectories, numbered trajectory by trajectory.

    It is what torch calls a map-style dataset: `len`, `windows[k]`, and `__getitems__`, by which
    `torch.utils.data.DataLoader` fetches a batch at once. `take` is the quickest way.
    """

    series: tuple[Series, ...]
    rows: Indices
    """Trajectories that the windows come from."""
    length: int
    """Frames of a window."""

    def __post_init__(self) -> None:
        frames = self.series[0].shape[1]
        if not 1 <= self.length <= frames:
            msg = f"length: got {self.length}, allowed is 1 to {frames} frames"
            raise InputError(msg)

    @property
    def per_trajectory(self) -> int:
        """Windows of one trajectory."""
        return self.series[0].shape[1] - self.length + 1

    def __len__(self) -> int:
        return len(self.rows) * self.per_trajectory

    def where(self, numbers: Indices) -> tuple[Indices, Indices]:
        """Row of the trajectory and first frame of each window."""
        return self.rows[numbers // self.per_trajectory], numbers % self.per_trajectory

    def take(self, numbers: Indices | Sequence[int]) -> tuple[NDArray[Any], ...]:
        """Read windows, one array a dataset, of shape (window, frame, …).

        Raises:
            IndexError: A number is not one of `len(windows)`.
        """
        numbers = np.asarray(numbers, dtype=np.int64)
        wrong = numbers[(numbers < 0) | (numbers >= len(self))]
        if len(wrong):
            msg = f"window {wrong[0]} of {len(self)}"
            raise IndexError(msg)
        row, frame = self.where(numbers)
        shard = np.searchsorted(self.series[0].first, row, side="right") - 1
        return tuple(self._gather(series, shard, row, frame) for series in self.series)

    def __getitem__(self, number: int) -> tuple[NDArray[Any], ...]:
        """Read one window, one array a dataset, of shape (frame, …)."""
        number = range(len(self))[number]
        return tuple(values[0] for values in self.take([number]))

    def __getitems__(self, numbers: Sequence[int]) -> list[tuple[NDArray[Any], ...]]:
        """Read several windows at once."""
        return list(zip(*self.take(numbers), strict=True))

    def _gather(self, series: Series, shard: Indices, row: Indices, frame: Indices) -> NDArray[Any]:
        shape = (len(row), self.length, *series.shape[2:])
        found = np.empty(shape, series.shard(0).dtype)
        for k in np.unique(shard):
            here = np.flatnonzero(shard == k)
            first = (row[here] - series.first[k]) * series.shape[1] + frame[here]
            frames = series.shard(int(k)).reshape(-1, *series.shape[2:])
            found[here] = frames[first[:, None] + self._steps]
        return found

    @functools.cached_property
    def _steps(self) -> Indices:
        return np.arange(self.length)
