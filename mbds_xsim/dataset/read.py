"""Read data files lazily: arrays as numpy gives them, straight from the bytes of the file."""

from __future__ import annotations

import functools
import mmap
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.content import CONTENT, check_content, values_of
from mbds_xsim.dataset.layout import known_names
from mbds_xsim.dataset.opened import opened
from mbds_xsim.dataset.plan import attributes_of
from mbds_xsim.dataset.split import NAMES
from mbds_xsim.dataset.windows import Windows
from mbds_xsim.errors import InputError
from mbds_xsim.scene import Scene

__all__ = ["Dataset", "Series", "load_dataset"]

_AT_ONCE = ("index", "split", "reason")
_OPEN = 256  # files that are mapped at a time


def load_dataset(path: str | Path) -> Dataset:
    """Open a data file: of one variant (`…/mujoco-matched.h5`), one shard, or the rejected.

    Nothing but the index is read. Arrays are read, or mapped, when they are asked for.

    Raises:
        InputError: It is no data file, of a newer layout, or its shards are not beside it.
    """
    path = Path(path)
    attributes = attributes_of(path)
    if attributes.get("kind") not in ("shard", "rejected", "joined"):
        msg = f"{path} holds no trajectories, it is of the kind {attributes.get('kind')!r}"
        raise InputError(msg)
    with opened(path) as file:
        small = {name: values_of(file[name]) for name in _small_names(file)}
    if attributes["kind"] != "joined":
        return Dataset(path, attributes, (path,), (len(small["index"]),), small)
    files = tuple(path.parent / name for name in small["shard/file"])
    missing = [file for file in files if not file.is_file()]
    if missing:
        msg = f"{path}: {len(missing)} of its {len(files)} shards are missing, first {missing[0]}"
        raise InputError(msg)
    return Dataset(path, attributes, files, tuple(map(int, small["shard/rows"])), small)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Trajectories of one scene in one engine. Rows are the published ones, by their index."""

    path: Path
    attributes: dict[str, Any]
    """How it was made: scene, engine, settings, seed, versions; see `docs/dataset-layout.md`."""
    files: tuple[Path, ...]
    """In which its trajectories are."""
    rows: tuple[int, ...]
    """How many each has."""
    small: dict[str, NDArray[Any]]
    """Index, split, and datasets that belong to no trajectory: time, graph, names of checks."""

    def __len__(self) -> int:
        return len(self.index)

    def __repr__(self) -> str:
        told = self.attributes
        return (
            f"<{told['scene_name']} {told['engine']} {told['profile']} ({told['certification']}): "
            f"{len(self)} trajectories of {told['steps']} steps of {told['frame_s']} s>"
        )

    def __getitem__(self, name: str) -> NDArray[Any] | Series:
        """Give a dataset by its path in the file; one of trajectories as a `Series`."""
        if name in self.small:
            return self.small[name]
        return Series(self.files, self.rows, name)

    @property
    def lack(self) -> str:
        """Says that there is nothing to read; "" where there is."""
        drawn = self.attributes["count"]
        return "" if len(self) else f"none of {drawn} trajectories drawn passed its checks"

    @property
    def index(self) -> NDArray[np.int64]:
        """Number of each trajectory, the same in all engines."""
        return self.small["index"]

    @property
    def position(self) -> Series:
        """Positions of the particles [m], shape (trajectory, frame, point, axis), float32."""
        return Series(self.files, self.rows, "position")

    @property
    def velocity(self) -> Series:
        """Velocities of the particles [m/s], shape (trajectory, frame, point, axis), float32."""
        return Series(self.files, self.rows, "velocity")

    @functools.cached_property
    def scene(self) -> Scene:
        """The scene, as the file has it."""
        import tomllib

        import msgspec

        return msgspec.convert(tomllib.loads(self.attributes["scene"]), Scene)

    def rows_of(self, split: str) -> NDArray[np.int64]:
        """Rows of "train", "validation" or "test".

        Raises:
            InputError: There is no such part, or the file is a shard, which has no split.
        """
        if split not in NAMES:
            msg = f"split: got {split!r}, allowed is {', '.join(NAMES)}"
            raise InputError(msg)
        if "split" not in self.small:
            msg = f"{self.path} is one shard; the split is in the file that joins the shards"
            raise InputError(msg)
        return np.flatnonzero(self.small["split"] == NAMES.index(split))

    def check(self, names: Collection[str] | None = None) -> None:
        """Hold values against the checksums that were written with them, which reading does not.

        Args:
            names: Only these datasets'; all when left out.

        Raises:
            InputError: Something is not what was written.
        """
        for path in dict.fromkeys((self.path, *self.files)):
            wrong = check_content(path, names)
            if wrong is not None:
                raise InputError(f"{path}: {wrong}; get it again, or generate it anew")
        for path, content in zip(self.files, self.small.get("shard/content", ()), strict=False):
            if attributes_of(path)[CONTENT] != content:
                msg = f"{path}: not the shard that {self.path.name} joins; generate it anew"
                raise InputError(msg)

    def windows(
        self,
        length: int,
        *,
        split: str | None = None,
        rows: NDArray[np.int64] | None = None,
        names: tuple[str, ...] = ("position", "velocity"),
    ) -> Windows:
        """All windows of so many frames, for training; a torch `Dataset` in all but name.

        Args:
            length: Frames of a window: of history and of target together.
            split: Only of this part.
            rows: Only of these trajectories, as of `joint.h5`.
            names: Which datasets to take.
        """
        chosen = np.arange(len(self)) if split is None else self.rows_of(split)
        if rows is not None:
            chosen = np.intersect1d(chosen, rows)
        return Windows(tuple(Series(self.files, self.rows, name) for name in names), chosen, length)


@dataclass(frozen=True, eq=False)
class Series:
    """A dataset of trajectories, over all shards, mapped from the files' bytes."""

    files: tuple[Path, ...]
    rows: tuple[int, ...]
    name: str

    @functools.cached_property
    def first(self) -> NDArray[np.int64]:
        """First row of each shard, then the number of rows."""
        return np.concatenate([[0], np.cumsum(self.rows)])

    @functools.cached_property
    def shape(self) -> tuple[int, ...]:
        """Of the whole."""
        return (int(self.first[-1]), *self.shard(0).shape[1:])

    def __len__(self) -> int:
        return int(self.first[-1])

    def __getitem__(self, row: int) -> NDArray[Any]:
        """Give one trajectory, mapped: nothing is read until it is looked at."""
        if not -len(self) <= row < len(self):
            msg = f"row {row} of {len(self)}"
            raise IndexError(msg)
        row %= len(self)
        shard = int(np.searchsorted(self.first, row, side="right")) - 1
        return self.shard(shard)[row - self.first[shard]]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        for shard in range(len(self.files)):
            yield from self.shard(shard)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Read the whole."""
        del copy
        whole = np.concatenate([self.shard(k) for k in range(len(self.files))])
        return whole if dtype is None else whole.astype(dtype)

    def shard(self, k: int) -> NDArray[Any]:
        """Map one shard, shape (trajectory, frame, …); it cannot be written to."""
        values = _mapped(self.files[k], self.name)
        if len(values) != self.rows[k]:
            msg = f"{self.files[k]} has {len(values)} trajectories, not the {self.rows[k]} expected"
            raise InputError(msg)
        return values


def _small_names(file: Any) -> Iterator[str]:
    """What is read at once: nothing from the shards of a joined file."""
    for name, field in known_names().items():
        if name in file and (name in _AT_ONCE or not field.per_trajectory):
            yield name


@functools.lru_cache(maxsize=2 * _OPEN)
def _mapped(path: Path, name: str) -> NDArray[Any]:
    offset, shape, dtype = _place(path, name)
    if 0 in shape:
        return np.empty(shape, dtype)
    count = int(np.prod(shape))
    return np.frombuffer(_bytes_of(path), dtype, count, offset).reshape(shape)


@functools.lru_cache(maxsize=_OPEN)
def _bytes_of(path: Path) -> mmap.mmap:
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _place(path: Path, name: str) -> tuple[int, tuple[int, ...], np.dtype[Any]]:
    """Where a dataset's values are in its file."""
    with opened(path) as file:
        if name not in file:
            msg = f"{path} has no dataset {name!r}"
            raise InputError(msg)
        dataset = file[name]
        return dataset.id.get_offset() or 0, dataset.shape, dataset.dtype
