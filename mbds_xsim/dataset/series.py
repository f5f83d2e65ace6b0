"""Datasets over all files of a data set, as numpy has arrays, and windows of their frames."""

from __future__ import annotations

import functools
import math
import mmap
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Index
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.hdf5 import open_hdf5, refuse_other, values_of

_OPEN = 256  # files that are mapped at a time

Stamp = tuple[int, int, int]
"""Of a file: its number in the file system, its size, and when it was changed."""


@dataclass(frozen=True)
class MappedFile:
    """A file with some of the trajectories of a data set."""

    path: Path
    rows: int
    stamp: Stamp
    """Of the file when it was opened: what is there later may be another."""

    @staticmethod
    def of(path: Path, rows: int) -> MappedFile:
        """Note what a file is now."""
        refuse_other(path)
        return MappedFile(path, rows, _stamp(path))

    def values(self, name: str, like: NDArray[Any]) -> NDArray[Any]:
        """Map a dataset, or read it where it cannot be mapped; it cannot be written to.

        Args:
            name: Of the dataset.
            like: An array of its type, and of its shape but for the number of rows.

        Raises:
            InputError: It is another than expected, or the file was changed.
        """
        values = _values(self, name)
        wanted = (self.rows, *like.shape[1:])
        if (values.shape, values.dtype) != (wanted, like.dtype):
            msg = (
                f"{self.path}: {name} is {values.dtype} of shape {values.shape}, expected is "
                f"{like.dtype} of {wanted}; get it again, or generate it anew"
            )
            raise InputError(msg)
        return values


@functools.lru_cache(maxsize=2 * _OPEN)
def _values(part: MappedFile, name: str) -> NDArray[Any]:
    with open_hdf5(part.path) as file:
        if _stamp(part.path) != part.stamp:
            msg = f"{part.path} was changed since the data set was opened; open it again"
            raise InputError(msg)
        dataset = file.get(name)
        if not isinstance(dataset, h5py.Dataset):
            msg = f"{part.path} has no dataset {name!r}"
            raise InputError(msg)
        offset = _offset(dataset, part.stamp)
        if offset is None:
            values = values_of(dataset)
            values.flags.writeable = False
            return values
        shape, dtype = dataset.shape, dataset.dtype
    return np.frombuffer(_bytes_of(part), dtype, math.prod(shape), offset).reshape(shape)


def _offset(dataset: Any, stamp: Stamp) -> int | None:
    """Where values are in a file as one run of bytes that numpy has alike; None: they are not.

    Every layout of HDF5 but the contiguous one keeps values in another form or place: chunks, which
    alone may have filters, the header (compact), other files (external, virtual). A type may also
    be stored as no type of numpy.
    """
    creation = dataset.id.get_create_plist()
    contiguous = creation.get_layout() == h5py.h5d.CONTIGUOUS
    if not contiguous or creation.get_nfilters() or creation.get_external_count():
        return None
    if not dataset.dtype.isnative or not dataset.id.get_type().equal(
        h5py.h5t.py_create(dataset.dtype, logical=True)
    ):
        return None
    offset: int | None = dataset.id.get_offset()  # None: nothing was ever written
    size = math.prod(dataset.shape) * dataset.dtype.itemsize
    inside = offset is not None and size and offset + size <= stamp[1]
    return offset if inside else None


@functools.lru_cache(maxsize=_OPEN)
def _bytes_of(part: MappedFile) -> mmap.mmap:
    with part.path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _stamp(path: Path) -> Stamp:
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


class Rows(ABC):
    """A dataset of trajectories that is indexed as an array, reading only the rows asked for.

    As in `series[3]`, `series[-1]`, `series[10:20, ::5]`, `series[[4, 2]]`, `series[mask]`.
    """

    name: str
    like: NDArray[Any]
    """An array of its type and shape without a trajectory."""

    @abstractmethod
    def __len__(self) -> int:
        """Count trajectories."""

    @abstractmethod
    def _one(self, row: int) -> NDArray[Any]:
        """Give one trajectory, by a row from 0 on."""

    @abstractmethod
    def _take(self, rows: Index) -> NDArray[Any]:
        """Read some trajectories, in the shape of their rows."""

    def __repr__(self) -> str:
        return f"<{self.name}: {self.dtype} of shape {self.shape}>"

    @property
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

    def __getitem__(self, key: Any) -> NDArray[Any]:
        """Give what an array of the whole would give."""
        rows, *rest = key if isinstance(key, tuple) and key else (key,)
        if isinstance(rows, int | np.integer) and not isinstance(rows, bool):
            if not -len(self) <= rows < len(self):
                msg = f"row {rows} of {len(self)}"
                raise IndexError(msg)
            one = self._one(int(rows) % len(self))
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
        return (self[row] for row in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Read the whole."""
        if copy is False:
            msg = f"{self.name}: an array of the whole is a copy of what is in the files"
            raise ValueError(msg)
        whole = self._take(np.arange(len(self)))
        return whole if dtype is None else whole.astype(dtype)


@dataclass(frozen=True, eq=False, repr=False)
class Series(Rows):
    """A dataset of trajectories, over all shards, mapped from the files' bytes.

    One trajectory is mapped, and cannot be written to; several are read.
    """

    parts: tuple[MappedFile, ...]
    name: str
    like: NDArray[Any]

    @functools.cached_property
    def first(self) -> Index:
        """First row of each shard, then the number of rows."""
        return np.concatenate([[0], np.cumsum([part.rows for part in self.parts])])

    def __len__(self) -> int:
        return int(self.first[-1])

    def shard(self, k: int) -> NDArray[Any]:
        """Map one shard, shape (trajectory, frame, …); it cannot be written to."""
        return self.parts[k].values(self.name, self.like)

    def shard_of(self, rows: Any) -> Any:
        """Number of the shard of each row."""
        return np.searchsorted(self.first, rows, side="right") - 1

    def _one(self, row: int) -> NDArray[Any]:
        shard = int(self.shard_of(row))
        return self.shard(shard)[row - self.first[shard]]

    def _take(self, rows: Index) -> NDArray[Any]:
        found = np.empty((*rows.shape, *self.like.shape[1:]), self.dtype)
        shard = self.shard_of(rows)
        for k in np.unique(shard):
            here = shard == k
            found[here] = self.shard(int(k))[rows[here] - self.first[k]]
        return found


@dataclass(frozen=True, eq=False, repr=False)
class PairedSeries(Rows):
    """A dataset of trajectories in several engines, shape (trajectory, engine, …)."""

    name: str
    like: NDArray[Any]
    members: tuple[Series, ...]
    rows: tuple[Index, ...]
    """Of each engine: the row of each trajectory."""

    @staticmethod
    def of(members: tuple[Series, ...], rows: tuple[Index, ...]) -> PairedSeries:
        """Put the same dataset of several engines side by side."""
        one = members[0]
        like = np.empty((0, len(members), *one.shape[1:]), one.dtype)
        return PairedSeries(one.name, like, members, rows)

    def __len__(self) -> int:
        return len(self.rows[0])

    def _one(self, row: int) -> NDArray[Any]:
        return self._take(np.array([row]))[0]

    def _take(self, rows: Index) -> NDArray[Any]:
        pairs = zip(self.members, self.rows, strict=True)
        return np.stack([one[own[rows]] for one, own in pairs], axis=rows.ndim)


@dataclass(frozen=True, eq=False)
class Windows:
    """All windows of some trajectories, numbered trajectory by trajectory.

    It is what torch calls a map-style dataset: `len`, `windows[k]`, and `__getitems__`, by which
    `torch.utils.data.DataLoader` fetches a batch at once. `take` is the quickest way.
    """

    series: tuple[Series, ...]
    rows: Index
    """Trajectories that the windows come from."""
    length: int
    """Frames of a window."""

    def __post_init__(self) -> None:
        frames = self.series[0].shape[1]
        if not isinstance(self.length, int | np.integer) or not 1 <= self.length <= frames:
            msg = f"length: got {self.length!r}, allowed is 1 to {frames} frames"
            raise InputError(msg)

    @property
    def per_trajectory(self) -> int:
        """Windows of one trajectory."""
        return self.series[0].shape[1] - self.length + 1

    def __len__(self) -> int:
        return len(self.rows) * self.per_trajectory

    def where(self, numbers: Index) -> tuple[Index, Index]:
        """Row of the trajectory and first frame of each window."""
        return self.rows[numbers // self.per_trajectory], numbers % self.per_trajectory

    def take(self, numbers: Index | Sequence[int]) -> tuple[NDArray[Any], ...]:
        """Read windows, one array a dataset, of shape (window, frame, …).

        Raises:
            IndexError: A number is not one of `len(windows)`.
        """
        given = np.asarray(numbers)
        if given.size and given.dtype.kind not in "iu":
            msg = f"windows are taken by whole numbers, got {given.dtype}"
            raise IndexError(msg)
        numbers = given.astype(np.int64)
        wrong = numbers[(numbers < 0) | (numbers >= len(self))]
        if len(wrong):
            msg = f"window {wrong[0]} of {len(self)}"
            raise IndexError(msg)
        row, frame = self.where(numbers)
        shard = self.series[0].shard_of(row)
        return tuple(self._gather(series, shard, row, frame) for series in self.series)

    def __getitem__(self, number: int) -> tuple[NDArray[Any], ...]:
        """Read one window, one array a dataset, of shape (frame, …)."""
        number = range(len(self))[number]
        return tuple(values[0] for values in self.take([number]))

    def __getitems__(self, numbers: Sequence[int]) -> list[tuple[NDArray[Any], ...]]:
        """Read several windows at once."""
        return list(zip(*self.take(numbers), strict=True))

    def _gather(self, series: Series, shard: Index, row: Index, frame: Index) -> NDArray[Any]:
        shape = (len(row), self.length, *series.shape[2:])
        found = np.empty(shape, series.shard(0).dtype)
        for k in np.unique(shard):
            here = np.flatnonzero(shard == k)
            first = (row[here] - series.first[k]) * series.shape[1] + frame[here]
            frames = series.shard(int(k)).reshape(-1, *series.shape[2:])
            found[here] = frames[first[:, None] + self._steps]
        return found

    @functools.cached_property
    def _steps(self) -> Index:
        return np.arange(self.length)
