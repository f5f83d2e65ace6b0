"""Arrays of npz and HDF5 files, some trajectories at a time, so that any file fits the memory."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mbds_xsim.dataset.content import values_of
from mbds_xsim.dataset.opened import check_sources, datasets_in, opened, refuse_bomb
from mbds_xsim.errors import InputError

__all__ = ["RANKS", "Piece", "read_hdf5", "read_npz"]

_AT_ONCE = 100_000  # frames of bodies or points; the checks take some 5 kB for each

RANKS = {
    "position": 4,
    "velocity": 4,
    "body/position": 4,
    "body/orientation": 4,
    "body/velocity": 4,
    "body/angular_velocity": 4,
    "input/force": 4,
    "input/torque": 3,
    "index": 1,
}
"""Arrays of trajectories, and how many axes they have where the first one counts trajectories."""


@dataclass(frozen=True)
class Piece:
    """Some trajectories of a file."""

    values: dict[str, NDArray[Any]]
    facts: dict[str, Any]
    first: int
    """Place of the first of them in the file."""
    total: int
    """Trajectories of the file."""


class _Source(Protocol):
    """An array in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of all of it."""

    def rows(self, first: int, count: int) -> NDArray[Any]:
        """Read some rows; called for ascending ones, without a gap."""

    def whole(self) -> NDArray[Any]:
        """Read all of it, where no rows have been."""


def read_hdf5(path: Path) -> Iterator[Piece]:
    """Read arrays by their paths and attributes as facts; of other datasets only the names."""
    with opened(path) as file:
        sources = {name: _Dataset(item) for name, item in datasets_in(file).items()}
        facts = {key: _plain(value) for key, value in file.attrs.items()}
        yield from _pieces(sources, facts, path)


def read_npz(path: Path) -> Iterator[Piece]:
    """Read arrays by their names; what has no axes is a fact."""
    with ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        refuse_bomb(path, sum(member.file_size for member in archive.infolist()))
        found = {
            name.removesuffix(".npy"): _Member(stack.enter_context(archive.open(name)), path)
            for name in archive.namelist()
        }
        facts = {name: one.whole().item() for name, one in found.items() if not one.shape}
        yield from _pieces({k: one for k, one in found.items() if one.shape}, facts, path)


def _pieces(sources: Mapping[str, _Source], facts: dict[str, Any], path: Path) -> Iterator[Piece]:
    many = {name for name, one in sources.items() if len(one.shape) == RANKS.get(name)}
    if many == {"index"}:
        many = set()  # one trajectory, whose arrays have no such axis
    counts = {name: sources[name].shape[0] for name in many}
    if len(set(counts.values())) > 1:
        sizes = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
        msg = f"{path}: got arrays of different numbers of trajectories: {sizes}"
        raise InputError(msg)
    total = max(counts.values(), default=1)
    if total < 1:
        msg = f"{path}: got no trajectory, allowed is 1 or more"
        raise InputError(msg)
    each = max((math.prod(sources[name].shape[1:3]) for name in many), default=1)
    size = max(1, _AT_ONCE // max(1, each))
    kept = {
        name: one.whole() if name in RANKS or name == "time" else np.empty(0)
        for name, one in sources.items()
        if name not in many
    }
    for first in range(0, total, size):
        count = min(size, total - first)
        rows = {name: sources[name].rows(first, count) for name in many}
        yield Piece({**kept, **rows}, facts, first, total)


class _Dataset:
    """Of an HDF5 file."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self.shape: tuple[int, ...] = dataset.shape or ()

    def rows(self, first: int, count: int) -> NDArray[Any]:
        if first == 0:
            check_sources(self._dataset)
        return np.asarray(self._dataset[first : first + count])

    def whole(self) -> NDArray[Any]:
        return values_of(self._dataset)


class _Member:
    """Of an npz file, which can be read from its beginning on alone."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self._file = file
        readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        try:
            version = npy.read_magic(file)
        except ValueError as error:
            msg = f"{path}: holds {file.name}, which is no array; allowed are arrays of numbers"
            raise InputError(msg) from error
        if version not in readers:
            msg = f"{path}: holds an array in version {version} of npy, allowed are 1.0 and 2.0"
            raise InputError(msg)
        self.shape, self._by_columns, self._dtype = readers[version](file)
        if self._dtype.hasobject:
            msg = f"{path}: holds Python objects; allowed are arrays of numbers"
            raise InputError(msg)
        self._read: NDArray[Any] | None = None

    def rows(self, first: int, count: int) -> NDArray[Any]:
        if self._by_columns:  # rows are all over it
            self._read = self.whole() if self._read is None else self._read
            return self._read[first : first + count]
        return self._take((count, *self.shape[1:]))

    def whole(self) -> NDArray[Any]:
        if self._by_columns:
            return self._take(self.shape[::-1]).transpose()
        return self._take(self.shape)

    def _take(self, shape: tuple[int, ...]) -> NDArray[Any]:
        wanted = math.prod(shape) * self._dtype.itemsize
        content = self._file.read(wanted)
        if len(content) < wanted:
            msg = "an array ends too early"
            raise EOFError(msg)
        return np.frombuffer(content, self._dtype).reshape(shape)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
