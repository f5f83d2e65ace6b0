"""A dataset of trajectories over all files of a data set, as numpy has arrays."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.mapped import Part

__all__ = ["Series"]


@dataclass(frozen=True, eq=False, repr=False)
class Series:
    """A dataset of trajectories, over all shards, mapped from the files' bytes.

    It is indexed as an array: `series[3]`, `series[-1]`, `series[10:20, ::5]`, `series[[4, 2]]`,
    `series[mask]`. One trajectory is mapped, and cannot be written to; several are read.
    """

    parts: tuple[Part, ...]
    name: str
    like: NDArray[Any]
    """An array of its type and shape without a trajectory."""

    def __repr__(self) -> str:
        return f"<{self.name}: {self.dtype} of shape {self.shape}>"

    @functools.cached_property
    def first(self) -> NDArray[np.int64]:
        """First row of each shard, then the number of rows."""
        return np.concatenate([[0], np.cumsum([part.rows for part in self.parts])])

    @functools.cached_property
    def shape(self) -> tuple[int, ...]:
        """Of the whole."""
        return (len(self), *self.like.shape[1:])

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return self.like.ndim

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""
        return self.like.dtype

    def __len__(self) -> int:
        return int(self.first[-1])

    def __getitem__(self, key: Any) -> NDArray[Any]:
        """Give what an array of the whole would give, reading only the trajectories asked for."""
        rows, *rest = key if isinstance(key, tuple) and key else (key,)
        if isinstance(rows, int | np.integer) and not isinstance(rows, bool):
            one = self._one(int(rows))
            return one[None][(0, *rest)] if rest else one
        chosen = np.arange(len(self))[rows] if isinstance(rows, slice | list | np.ndarray) else None
        if chosen is None or (rest and chosen.ndim != 1):
            return np.asarray(self)[key]
        taken = self._take(chosen)
        if not rest:
            return taken
        # Beside other arrays, that of the rows goes in step with them, as numpy has it.
        own = slice(None) if isinstance(rows, slice) else np.arange(len(taken))
        return taken[(own, *rest)]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        for shard in range(len(self.parts)):
            yield from self.shard(shard)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Read the whole."""
        if copy is False:
            msg = f"{self.name}: an array of the whole is a copy of what is in the files"
            raise ValueError(msg)
        whole = np.concatenate([self.shard(k) for k in range(len(self.parts))])
        return whole if dtype is None else whole.astype(dtype)

    def shard(self, k: int) -> NDArray[Any]:
        """Map one shard, shape (trajectory, frame, …); it cannot be written to."""
        return self.parts[k].values(self.name, self.like)

    def _one(self, row: int) -> NDArray[Any]:
        if not -len(self) <= row < len(self):
            msg = f"row {row} of {len(self)}"
            raise IndexError(msg)
        row %= len(self)
        shard = int(np.searchsorted(self.first, row, side="right")) - 1
        return self.shard(shard)[row - self.first[shard]]

    def _take(self, rows: NDArray[np.int64]) -> NDArray[Any]:
        found = np.empty((*rows.shape, *self.like.shape[1:]), self.dtype)
        shard = np.searchsorted(self.first, rows, side="right") - 1
        for k in np.unique(shard):
            here = shard == k
            found[here] = self.shard(int(k))[rows[here] - self.first[k]]
        return found
