"""Read data files lazily: arrays as numpy gives them, straight from the bytes of the file."""

from __future__ import annotations

import re
from collections.abc import Collection, ItemsView, Iterator, KeysView, Mapping, Sequence, ValuesView
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError, UnknownName
from mbds_xsim.base.files import path_of
from mbds_xsim.base.frame import optional
from mbds_xsim.dataset.hdf5 import (
    CONTENT,
    attributes_of,
    check_content,
    check_fit,
    open_hdf5,
    scene_of,
    values_of,
)
from mbds_xsim.dataset.layout import FIELDS, SPLITS, SUFFIX
from mbds_xsim.dataset.series import MappedFile, Series, Windows
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Failure, Trajectory

_LONGEST = 10_000_000  # range of numbers of trajectories
_AT_ONCE = ("index", "split", "reason")


class UnknownDataset(UnknownName, KeyError):
    """A name under which a data set has nothing."""

    __str__ = Exception.__str__  # that of KeyError puts quotes around the line


def load_dataset(path: str | Path) -> Dataset:
    """Open a data file: of one variant (`…/mujoco-matched.h5`), one shard, or the rejected.

    Nothing but the index is read. Arrays are read, or mapped, when they are asked for.

    Raises:
        InputError: It is no data file, of a newer layout, damaged, or its shards are not beside it.
    """
    path = path_of("path", path)
    attributes = attributes_of(path)
    kind = attributes["kind"]
    if kind not in ("shard", "rejected", "joined"):
        msg = f"{path} holds no trajectories, it is of the kind {kind!r}"
        raise InputError(msg)
    scene = scene_of(attributes["scene"], path)
    with open_hdf5(path) as file:
        check_fit(file, path, kind, scene)
        found = {name: field for name, field in FIELDS.items() if name in file}
        small = {
            name: values_of(file[name])
            for name, field in found.items()
            if name in _AT_ONCE or not field.per_trajectory
        }
        like = {
            name: np.empty((0, *file[name].shape[1:]), file[name].dtype)
            for name in found
            if name not in small
        }
    parts: tuple[MappedFile, ...] = (MappedFile.of(path, len(small["index"])),)
    if kind == "joined":
        parts = tuple(_parts(path, small))
    return Dataset(path, attributes, scene, parts, small, like)


def _parts(path: Path, small: dict[str, NDArray[Any]]) -> Iterator[MappedFile]:
    """Find the shards that a file joins."""
    files = tuple(path.parent / name for name in small["shard/file"])
    missing = [file for file in files if not file.is_file()]
    if missing:
        msg = f"{path}: {len(missing)} of its {len(files)} shards are missing, first {missing[0]}"
        raise InputError(msg)
    rows = small["shard/rows"].tolist()
    if min(rows, default=0) < 0 or sum(rows) != len(small["index"]):
        msg = f"{path}: shard/rows do not make up its {len(small['index'])} trajectories"
        raise InputError(f"{msg}; get it again, or generate it anew")
    yield from map(MappedFile.of, files, rows)


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Trajectories of one scene in one engine: a mapping from names of datasets to their values.

    As in a frame of pandas, iterating and `in` are about names, `len` about rows: these are the
    published trajectories, by their index. What belongs to trajectories comes as a `Series`, to be
    indexed by row; what belongs to all, such as `time` or `graph/edge`, as an array.
    """

    path: Path
    attributes: dict[str, Any]
    """How it was made: scene, engine, settings, seed, versions; see `docs/dataset-layout.md`."""
    scene: Scene
    """The scene, as the file has it."""
    parts: tuple[MappedFile, ...]
    """Files in which its trajectories are, and how many each has."""
    small: dict[str, NDArray[Any]]
    """Index, split, and datasets that belong to no trajectory: time, graph, names of checks."""
    like: dict[str, NDArray[Any]]
    """The others: arrays of their type and shape, without a trajectory."""

    def __len__(self) -> int:
        return len(self.index)

    def __repr__(self) -> str:
        attrs = self.attributes
        made = f"{attrs['engine']} {attrs['profile']} ({attrs['certification']})"
        return (
            f"<{attrs['scene_name']} {made}: "
            f"{len(self)} trajectories of {attrs['steps']} steps of {attrs['frame_s']} s>"
        )

    def __getitem__(self, name: Any) -> NDArray[Any] | Series:
        """Give a dataset by its path in the file; one of trajectories as a `Series`.

        Raises:
            UnknownDataset: The file has none of this name.
        """
        if not isinstance(name, str):
            got = repr(name) if isinstance(name, int | slice) else "…"
            msg = (
                f"data[{got}]: a data set is indexed by names of its datasets; give rows of "
                f'trajectories to one of them, as data["position"][{got}]'
            )
            raise UnknownDataset(msg)
        if name in self.small:
            return self.small[name]
        if name not in self.like:
            raise UnknownDataset.of("dataset", name, list(self))
        return self._series(name)

    def __contains__(self, name: object) -> bool:
        return name in self.small or name in self.like

    def __iter__(self) -> Iterator[str]:
        return (name for name in FIELDS if name in self)

    def keys(self) -> KeysView[str]:
        """Names of the datasets, in the order of the layout."""
        return dict.fromkeys(self).keys()

    def values(self) -> ValuesView[NDArray[Any] | Series]:
        """The datasets, in the order of their names."""
        return {name: self[name] for name in self}.values()

    def items(self) -> ItemsView[str, NDArray[Any] | Series]:
        """Names and datasets."""
        return {name: self[name] for name in self}.items()

    def get(self, name: str, default: Any = None) -> Any:
        """Give a dataset, or the default where the file has none of this name."""
        try:
            return self[name]
        except UnknownDataset:
            return default

    @property
    def files(self) -> tuple[Path, ...]:
        """Files in which its trajectories are."""
        return tuple(part.path for part in self.parts)

    @property
    def variant(self) -> str:
        """Engine and settings, as in `mujoco-matched`."""
        return f"{self.attributes['engine']}-{self.attributes['profile']}"

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
    def time(self) -> NDArray[np.float64]:
        """Of each frame [s], shape (frame,)."""
        return self.small["time"]

    @property
    def position(self) -> Series:
        """Positions of the particles [m], shape (trajectory, frame, point, axis), float32."""
        return self._series("position")

    @property
    def velocity(self) -> Series:
        """Velocities of the particles [m/s], shape (trajectory, frame, point, axis), float32."""
        return self._series("velocity")

    def _series(self, name: str) -> Series:
        if name not in self.like:
            raise UnknownDataset.of("dataset of trajectories", name, list(self.like))
        return Series(self.parts, name, self.like[name])

    def rows_of(self, split: str) -> NDArray[np.int64]:
        """Rows of "train", "validation" or "test".

        Raises:
            InputError: There is no such part, or the file is a shard, which has no split.
        """
        if split not in SPLITS:
            msg = f"split: got {split!r}, allowed is {', '.join(SPLITS)}"
            raise InputError(msg)
        if "split" not in self.small:
            msg = f"{self.path} is one shard; the split is in the file that joins the shards"
            raise InputError(msg)
        return np.flatnonzero(self.small["split"] == SPLITS.index(split))

    def to_xarray(
        self, names: Sequence[str] = ("position", "velocity"), rows: Any = slice(None)
    ) -> Any:
        """Read datasets of trajectories into an `xarray.Dataset` with the axes of the layout.

        Args:
            names: Which datasets to read.
            rows: Of which trajectories: a slice, a list or a mask.

        Raises:
            InputError: xarray is not installed.
        """
        arrays = {name: (FIELDS[name].axes, self[name][rows]) for name in names}
        return labelled(arrays, trajectory=self.index[rows], frame=self.time)

    def batch(self, rows: Any = slice(None)) -> Batch:
        """Starts and inputs of trajectories, the noise included."""
        starts = {key: self._series(f"start/{key}")[rows] for key in STATES}
        force, torque = self._series("input/force")[rows], self._series("input/torque")[rows]
        return Batch(index=self.index[rows], **starts, force=force, torque=torque)

    def trajectory(self, rows: Any = slice(None)) -> Trajectory:
        """Motions of the bodies; one that has no numbers to its end is a failure."""
        states = {key: self._series(f"body/{key}")[rows] for key in STATES}
        each = [np.isfinite(values).all(axis=(2, 3)) for values in states.values()]
        failures = tuple(
            None if row.all() else Failure(int(np.argmin(row)), "no numbers")
            for row in np.logical_and.reduce(each)
        )
        return Trajectory(self.time, **states, failures=failures)

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
            rows: Only of these trajectories: their rows, as of `joint.h5`, or a mask of all.
            names: Which datasets to take.
        """
        chosen = np.arange(len(self)) if split is None else self.rows_of(split)
        if rows is not None:
            chosen = np.intersect1d(chosen, np.arange(len(self))[rows])
        return Windows(tuple(map(self._series, names)), chosen, length)


def labelled(arrays: Mapping[str, tuple[tuple[str, ...], Any]], **coordinates: Any) -> Any:
    """Give an `xarray.Dataset` of arrays, each with its axes, and of coordinates of their axes.

    Raises:
        InputError: xarray is not installed.
    """
    xarray = optional("xarray", "to_xarray()", "frames")
    used = {axis for axes, _ in arrays.values() for axis in axes}
    return xarray.Dataset(
        dict(arrays), coords={axis: coordinates[axis] for axis in coordinates if axis in used}
    )


def joined_files(path: Path, engines: str | None = None) -> list[Path]:
    """Give the data sets of a folder, or the one that a file is.

    Args:
        path: A data file, or a folder that `mbds-xsim generate` has made, or one within.
        engines: Only those of these, comma-separated.

    Raises:
        InputError: There are none.
    """
    if not path.exists():
        msg = f"{path}: there is no such file or folder"
        raise InputError(msg)
    # Named by engine and settings; shards are by a number, and files of others need not be read.
    sets = [path] if path.is_file() else sorted(path.rglob(f"*-*{SUFFIX}"))
    kinds = {file: attributes_of(file) for file in sets}
    found = [file for file, attrs in kinds.items() if path.is_file() or attrs["kind"] == "joined"]
    if not found:
        msg = f"{path} holds no data set; name a folder that mbds-xsim generate has finished"
        raise InputError(msg)
    if engines is None:
        return found
    wanted = [word.strip() for word in engines.split(",")]
    there = sorted({str(kinds[file].get("engine")) for file in found})
    strange = [word for word in wanted if word not in there]
    if strange:
        msg = f"--engines: got {strange[0]!r}, allowed for {path} is {', '.join(there)}"
        raise InputError(msg)
    return [file for file in found if kinds[file].get("engine") in wanted]


def parse_numbers(text: str, option: str) -> list[int]:
    """Read numbers and ranges, ascending, each once.

    Raises:
        InputError: It is something else, or a range that would fill the memory.
    """
    found: set[int] = set()
    for word in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,15})(?:-(\d{1,15}))?\s*", word)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not 0 <= last - first < _LONGEST:
            msg = (
                f"{option}: got {text!r}, allowed are numbers and ranges of up to {_LONGEST}, as "
                "0-9,15"
            )
            raise InputError(msg)
        found |= set(range(first, last + 1))
    return sorted(found)
