"""Datasets over all files of a data set, used like numpy arrays, and windows of their frames."""

from __future__ import annotations

import functools
import math
import mmap
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Index
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.hdf5 import open_hdf5, refuse_other, values_of
from mbds_xsim.dataset.layout import FIELDS

_OPEN = 256  # files that are mapped at a time
_FOUND = 2**16  # places of datasets in files that are remembered

Stamp = tuple[int, int, int]
"""Identity of a file: its inode number, its size, and the time of its last change [ns]."""


@dataclass(frozen=True)
class MappedFile:
    """A file with some of the trajectories of a data set."""

    path: Path
    rows: int
    stamp: Stamp
    """Stamp of the file when it was opened; another file may take its place later."""

    @staticmethod
    def of(path: Path, rows: int) -> MappedFile:
        """Record the present state of a file."""
        refuse_other(path)
        return MappedFile(path, rows, _stamp(path))

    def values(self, name: str, like: NDArray[Any]) -> NDArray[Any]:
        """Map a dataset, or read it if it cannot be mapped; the result is read-only.

        Args:
            name: Name of the dataset.
            like: Array with the type and shape of the dataset, except for the number of rows.

        Raises:
            InputError: The dataset has another type or shape, or the file was changed.
        """
        values = _values(self, name)
        wanted = (self.rows, *like.shape[1:])
        more = values.ndim == like.ndim and len(values) > self.rows
        if more and (values.shape[1:], values.dtype) == (like.shape[1:], like.dtype):
            raise InputError(being_extended(self.path))
        if (values.shape, values.dtype) != (wanted, like.dtype):
            raise InputError(
                f"{self.path}: {name} is {values.dtype} of shape {values.shape}, expected is "
                f"{like.dtype} of {wanted}; get it again, or generate it anew"
            )
        return values


def being_extended(path: Path) -> str:
    """Describe a shard with more trajectories than the joined file, which is written last, says."""
    return (
        f"{path} has more trajectories than its data set: the set is being extended; run the "
        "larger `generate` again to finish"
    )


@functools.lru_cache(maxsize=2 * _OPEN)
def _values(part: MappedFile, name: str) -> NDArray[Any]:
    place = _place(part, name)
    if place is not None:
        offset, dtype, shape = place
        return np.frombuffer(_bytes_of(part), dtype, math.prod(shape), offset).reshape(shape)
    with _dataset(part, name) as dataset:
        values = values_of(dataset)
    values.flags.writeable = False
    return values


@functools.lru_cache(maxsize=_FOUND)
def _place(part: MappedFile, name: str) -> tuple[int, np.dtype[Any], tuple[int, ...]] | None:
    """Find where a file has a dataset, which takes much longer than to map it again."""
    with _dataset(part, name) as dataset:
        offset = _offset(dataset, part.stamp)
        return None if offset is None else (offset, dataset.dtype, dataset.shape)


@contextmanager
def _dataset(part: MappedFile, name: str) -> Iterator[Any]:
    with open_hdf5(part.path) as file:
        _check_unchanged(part)
        dataset = file.get(name)
        if not isinstance(dataset, h5py.Dataset):
            raise InputError(f"{part.path} has no dataset {name!r}")
        yield dataset


def _check_unchanged(part: MappedFile) -> None:
    if _stamp(part.path) != part.stamp:
        raise InputError(f"{part.path} was changed since the data set was opened; open it again")


def _offset(dataset: Any, stamp: Stamp) -> int | None:
    """Return where values start in a file if numpy can map them as one run of bytes, else None.

    Every layout of HDF5 but the contiguous one keeps values in another form or place: chunks, which
    alone may have filters, the header (compact), other files (external, virtual). A type may also
    be stored in a form that numpy does not have.
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
    refuse_other(part.path)
    with part.path.open("rb") as file:
        _check_unchanged(part)
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _stamp(path: Path) -> Stamp:
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


class Rows(ABC):
    """Dataset of trajectories that is indexed like an array, and reads only the rows asked for.

    Examples: `series[3]`, `series[-1]`, `series[10:20, ::5]`, `series[[4, 2]]`, `series[mask]`.
    """

    name: str
    like: NDArray[Any]
    """Array of the same type and shape, without a trajectory."""

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of trajectories."""

    def _one(self, row: int) -> NDArray[Any]:
        """Return one trajectory, by a row counted from 0."""
        return self._take(np.array([row]))[0]

    @abstractmethod
    def _take(self, rows: Index) -> NDArray[Any]:
        """Read some trajectories; the first axes of the result are those of `rows`."""

    def __repr__(self) -> str:
        return f"<{self.name}: {self.dtype} of shape {self.shape}>"

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the whole dataset."""
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
        """Index the dataset as if it were one array."""
        rows, *rest = key if isinstance(key, tuple) and key else (key,)
        if isinstance(rows, int | np.integer) and not isinstance(rows, bool):
            if not -len(self) <= rows < len(self):
                raise IndexError(f"row {rows} of {len(self)}")
            one = self._one(int(rows) % len(self))
            return one[None][(0, *rest)] if rest else one
        chosen = np.arange(len(self))[rows] if isinstance(rows, slice | list | np.ndarray) else None
        if chosen is None or (rest and chosen.ndim != 1):
            return np.asarray(self)[key]
        values = self._take(chosen)
        if not rest:
            return values
        # As in numpy, the array of rows advances in step with other index arrays.
        own = slice(None) if isinstance(rows, slice) else np.arange(len(values))
        return values[(own, *rest)]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return (self[row] for row in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Read the whole dataset."""
        if copy is False:
            msg = f"{self.name}: got copy=False, but an array of the whole dataset is a copy"
            raise ValueError(msg)
        whole = self._take(np.arange(len(self)))
        return whole if dtype is None else whole.astype(dtype)


@dataclass(frozen=True, eq=False, repr=False)
class Series(Rows):
    """A dataset of trajectories, over all shards, mapped from the files' bytes.

    A single trajectory is mapped and read-only; several are read into a new array.
    """

    parts: tuple[MappedFile, ...]
    name: str
    like: NDArray[Any]

    @functools.cached_property
    def first(self) -> Index:
        """First row of each shard, and last the number of rows."""
        return np.concatenate([[0], np.cumsum([part.rows for part in self.parts])])

    def __len__(self) -> int:
        return int(self.first[-1])

    def shard(self, k: int) -> NDArray[Any]:
        """Map one shard as a read-only array, shape (trajectory, frame, …)."""
        return self.parts[k].values(self.name, self.like)

    def shard_of(self, rows: Any) -> Any:
        """Return the number of the shard that holds each row."""
        return np.searchsorted(self.first, rows, side="right") - 1

    def _one(self, row: int) -> NDArray[Any]:
        shard = int(self.shard_of(row))
        return self.shard(shard)[row - self.first[shard]]

    def _take(self, rows: Index) -> NDArray[Any]:
        values = np.empty((*rows.shape, *self.like.shape[1:]), self.dtype)
        shard = self.shard_of(rows)
        for k in np.unique(shard):
            in_shard = shard == k
            values[in_shard] = self.shard(int(k))[rows[in_shard] - self.first[k]]
        return values


@dataclass(frozen=True, eq=False, repr=False)
class PairedSeries(Rows):
    """A dataset of trajectories in several engines, shape (trajectory, engine, …)."""

    name: str
    like: NDArray[Any]
    members: tuple[Series, ...]
    rows: tuple[Index, ...]
    """Rows of the trajectories in each engine's data."""

    @staticmethod
    def of(members: tuple[Series, ...], rows: tuple[Index, ...]) -> PairedSeries:
        """Put the same dataset of several engines side by side."""
        one = members[0]
        like = np.empty((0, len(members), *one.shape[1:]), one.dtype)
        return PairedSeries(one.name, like, members, rows)

    def __len__(self) -> int:
        return len(self.rows[0])

    def _take(self, rows: Index) -> NDArray[Any]:
        pairs = zip(self.members, self.rows, strict=True)
        return np.stack([one[own[rows]] for one, own in pairs], axis=rows.ndim)


@dataclass(frozen=True, eq=False)
class Windows:
    """All windows of some trajectories, numbered trajectory by trajectory.

    It is what torch calls a map-style dataset: it has `len`, `windows[k]`, and `__getitems__`, with
    which `torch.utils.data.DataLoader` fetches a batch at once. `take` is the fastest way to read.
    """

    series: tuple[Series, ...]
    rows: Index
    """Rows of the trajectories that the windows come from."""
    length: int
    """Number of frames in a window."""

    def __post_init__(self) -> None:
        if not self.series:
            raise InputError("names: got none, allowed are datasets of frames or of steps")
        for series in self.series:
            if FIELDS[series.name].axes[1:2] not in (("frame",), ("step",)):
                raise InputError(
                    f"names: got {series.name!r}, which has neither frames nor steps; allowed are "
                    "datasets that have, as position"
                )
        frames = self._frames
        if not isinstance(self.length, int | np.integer) or not 1 <= self.length <= frames:
            raise InputError(f"length: got {self.length!r}, allowed is 1 to {frames} frames")

    @property
    def _frames(self) -> int:
        """Number of frames in a trajectory, or of steps if there are datasets of both."""
        return min(series.shape[1] for series in self.series)

    @property
    def per_trajectory(self) -> int:
        """Number of windows in one trajectory, each of which lies in all datasets."""
        return self._frames - self.length + 1

    def __len__(self) -> int:
        return len(self.rows) * self.per_trajectory

    def where(self, numbers: Index) -> tuple[Index, Index]:
        """Return the row of the trajectory and the first frame of each window."""
        return self.rows[numbers // self.per_trajectory], numbers % self.per_trajectory

    def take(self, numbers: Index | Sequence[int]) -> tuple[NDArray[Any], ...]:
        """Read windows: one array per dataset, of shape (window, frame, …).

        Raises:
            IndexError: The numbers are no row of integers from 0 to `len(windows)` − 1.
        """
        indices = np.asarray(numbers)
        if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "iu"):
            got = f"{indices.dtype} of shape {indices.shape}"
            raise IndexError(f"windows are taken by whole numbers in a row, got {got}")
        numbers = indices.astype(np.int64)
        outside = numbers[(numbers < 0) | (numbers >= len(self))]
        if len(outside):
            raise IndexError(f"window {outside[0]} of {len(self)}")
        row, frame = self.where(numbers)
        shard = self.series[0].shard_of(row)
        shapes = [(len(row), self.length, *series.shape[2:]) for series in self.series]
        windows = [np.empty(s, series.dtype) for s, series in zip(shapes, self.series, strict=True)]
        for k in np.unique(shard).tolist():
            here = np.flatnonzero(shard == k)
            for values, series in zip(windows, self.series, strict=True):
                first = (row[here] - series.first[k]) * series.shape[1] + frame[here]
                frames = series.shard(k).reshape(-1, *series.shape[2:])
                values[here] = frames[first[:, None] + np.arange(self.length)]
        return tuple(windows)

    def __getitem__(self, number: int) -> tuple[NDArray[Any], ...]:
        """Read one window: one array per dataset, of shape (frame, …)."""
        number = range(len(self))[number]
        return tuple(values[0] for values in self.take([number]))

    def __getitems__(self, numbers: Sequence[int]) -> list[tuple[NDArray[Any], ...]]:
        """Read several windows at once."""
        return list(zip(*self.take(numbers), strict=True))
