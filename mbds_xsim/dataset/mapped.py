"""Values in HDF5 files as arrays: mapped from the file's bytes where these are what numpy has."""

from __future__ import annotations

import functools
import math
import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.content import values_of
from mbds_xsim.dataset.opened import opened, refuse_other
from mbds_xsim.errors import InputError

__all__ = ["Part"]

_OPEN = 256  # files that are mapped at a time

Stamp = tuple[int, int, int]
"""Of a file: its number in the file system, its size, and when it was changed."""


@dataclass(frozen=True)
class Part:
    """A file with some of the trajectories of a data set."""

    path: Path
    rows: int
    stamp: Stamp
    """Of the file when it was opened: what is there later may be another."""

    @staticmethod
    def of(path: Path, rows: int) -> Part:
        """Note what a file is now."""
        refuse_other(path)
        return Part(path, rows, _stamp(path))

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
def _values(part: Part, name: str) -> NDArray[Any]:
    with opened(part.path) as file:
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
def _bytes_of(part: Part) -> mmap.mmap:
    with part.path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _stamp(path: Path) -> Stamp:
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns
