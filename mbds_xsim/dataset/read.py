"""Lazy reading of data files: numpy arrays straight from the bytes of the files."""

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
    variant_files,
)
from mbds_xsim.dataset.layout import FIELDS, SPLITS
from mbds_xsim.dataset.series import MappedFile, Series, Windows, being_extended
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Failure, Trajectory

_LONGEST = 10_000_000  # most numbers of trajectories in one text
_AT_ONCE = ("index", "split", "reason")


class UnknownDataset(UnknownName, KeyError):
    """Error for the name of a dataset that a file does not have."""

    __str__ = Exception.__str__  # KeyError's own puts quotes around the line


def load_dataset(path: str | Path) -> Dataset:
    """Open a data file: one variant (`…/mujoco-matched.h5`), one shard, or rejected trajectories.

    Only the index and other small datasets are read now. Series are read or mapped when used.

    Raises:
        InputError: It is no data file, has a newer layout, is damaged, or its shards are missing.
    """
    path = path_of("path", path)
    attributes = attributes_of(path)
    kind = attributes["kind"]
    if kind not in ("shard", "rejected", "joined"):
        raise InputError(f"{path} holds no trajectories, it is of the kind {kind!r}")
    scene = scene_of(attributes["scene"], path)
    with open_hdf5(path) as file:
        check_fit(file, path, kind, scene)
        fields = {name: field for name, field in FIELDS.items() if name in file}
        small = {
            name: values_of(file[name])
            for name, field in fields.items()
            if name in _AT_ONCE or not field.per_trajectory
        }
        like = {
            name: np.empty((0, *file[name].shape[1:]), file[name].dtype)
            for name in fields
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

    As in a pandas DataFrame, iteration and `in` go over names, and `len` counts rows. Rows are the
    file's trajectories, ordered by index. A dataset of trajectories is a `Series`, indexed by row;
    a dataset that all trajectories share, such as `time` or `graph/edge`, is an array.
    """

    path: Path
    attributes: dict[str, Any]
    """Scene, engine, settings, seed, versions and more; see `docs/dataset-layout.md`."""
    scene: Scene
    """Scene as the file has it."""
    parts: tuple[MappedFile, ...]
    """Files that hold the trajectories, with the number of rows in each."""
    small: dict[str, NDArray[Any]]
    """Index, split, reason, and datasets that belong to no trajectory: time, graph, check names."""
    like: dict[str, NDArray[Any]]
    """Empty arrays with the type and shape of all other datasets, keyed by name."""

    def __len__(self) -> int:
        return len(self.index)

    def __repr__(self) -> str:
        attrs = self.attributes
        source = f"{attrs['engine']} {attrs['profile']} ({self.standing})"
        return (
            f"<{attrs['scene_name']} {source}: "
            f"{len(self)} trajectories of {attrs['steps']} steps of {attrs['frame_s']} s>"
        )

    def __getitem__(self, name: Any) -> NDArray[Any] | Series:
        """Return a dataset by its path in the file; one of trajectories as a `Series`.

        Raises:
            UnknownDataset: The file has no dataset of this name.
        """
        if not isinstance(name, str):
            got = repr(name) if isinstance(name, int | slice) else "…"
            raise UnknownDataset(
                f"data[{got}]: a data set is indexed by names of its datasets; give rows of "
                f'trajectories to one of them, as data["position"][{got}]'
            )
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
        """Return the names of the datasets, in the order of the layout."""
        return dict.fromkeys(self).keys()

    def values(self) -> ValuesView[NDArray[Any] | Series]:
        """Return the datasets, in the order of the layout."""
        return {name: self[name] for name in self}.values()

    def items(self) -> ItemsView[str, NDArray[Any] | Series]:
        """Return names and datasets, in the order of the layout."""
        return {name: self[name] for name in self}.items()

    def get(self, name: str, default: Any = None) -> Any:
        """Return a dataset, or the default if the file has none of this name."""
        try:
            return self[name]
        except UnknownDataset:
            return default

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that hold the trajectories."""
        return tuple(part.path for part in self.parts)

    @property
    def variant(self) -> str:
        """Engine and settings, as in `mujoco-matched`."""
        return f"{self.attributes['engine']}-{self.attributes['profile']}"

    @property
    def is_rejected(self) -> bool:
        """Whether these are trajectories that failed their checks."""
        return bool(self.attributes["kind"] == "rejected")

    @property
    def standing(self) -> str:
        """Whether they are certified, as text for people."""
        certification: str = self.attributes["certification"]
        return "rejected, do not use as data" if self.is_rejected else certification

    @property
    def lack(self) -> str:
        """Message that there is nothing to read; empty if there is something."""
        drawn = self.attributes["count"]
        return "" if len(self) else f"none of {drawn} trajectories drawn passed its checks"

    @property
    def index(self) -> NDArray[np.int64]:
        """Number of each trajectory, the same in all engines."""
        return self.small["index"]

    @property
    def time(self) -> NDArray[np.float64]:
        """Time of each frame [s], shape (frame,)."""
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
        """Return the rows of "train", "validation" or "test".

        Raises:
            InputError: There is no such part, or the file is a shard, which has no split.
        """
        if split not in SPLITS:
            raise InputError(f"split: got {split!r}, allowed is {', '.join(SPLITS)}")
        if "split" not in self.small:
            msg = f"{self.path} is one shard; the split is in the file that joins the shards"
            raise InputError(msg)
        return np.flatnonzero(self.small["split"] == SPLITS.index(split))

    def to_xarray(
        self, names: str | Sequence[str] = ("position", "velocity"), rows: Any = slice(None)
    ) -> Any:
        """Read datasets into an `xarray.Dataset` with the axes of the layout.

        Args:
            names: Datasets to read: one name or several.
            rows: Rows of the trajectories to read: a slice, a list or a mask.

        Raises:
            UnknownDataset: The file has no dataset of one of these names.
            InputError: xarray is not installed.
        """
        arrays, rows = {}, _several(rows)
        for name in [names] if isinstance(names, str) else names:
            values = self[name]  # refuses unknown names
            own = values[rows] if FIELDS[name].per_trajectory else values
            arrays[name] = (FIELDS[name].axes, own)
        return labelled(arrays, trajectory=self.index[rows], frame=self.time)

    def batch(self, rows: Any = slice(None)) -> Batch:
        """Return the starts and inputs of trajectories, including the noise."""
        rows = _several(rows)
        starts = {key: self._series(f"start/{key}")[rows] for key in STATES}
        force, torque = self._series("input/force")[rows], self._series("input/torque")[rows]
        return Batch(index=self.index[rows], **starts, force=force, torque=torque)

    def trajectory(self, rows: Any = slice(None)) -> Trajectory:
        """Return the motions of the bodies; one with NaN or infinity counts as a failure."""
        rows = _several(rows)
        states = {key: self._series(f"body/{key}")[rows] for key in STATES}
        finite = [np.isfinite(values).all(axis=(2, 3)) for values in states.values()]
        failures = tuple(
            None if row.all() else Failure(int(np.argmin(row)), "no numbers")
            for row in np.logical_and.reduce(finite)
        )
        return Trajectory(self.time, **states, failures=failures)

    def check(self, names: Collection[str] | None = None) -> None:
        """Compare values with the checksums that were written with them; reading does not do so.

        Args:
            names: Datasets to check; all if None.

        Raises:
            UnknownDataset: The file has no dataset of one of these names.
            InputError: A file is not what was written.
        """
        names = [names] if isinstance(names, str) else names
        for name in names or ():
            self[name]  # refuses unknown names
        for path in dict.fromkeys((self.path, *self.files)):
            fault = check_content(path, names)
            if fault is not None:
                raise InputError(f"{path}: {fault}; get it again, or generate it anew")
        for part, content in zip(self.parts, self.small.get("shard/content", ()), strict=False):
            path, attrs = part.path, attributes_of(part.path)
            if attrs[CONTENT] != content:
                if attrs["published"] > part.rows:
                    raise InputError(being_extended(path))
                msg = f"{path}: not the shard that {self.path.name} joins; generate it anew"
                raise InputError(msg)

    def windows(
        self,
        length: int,
        *,
        split: str | None = None,
        rows: NDArray[np.int64] | None = None,
        names: str | Sequence[str] = ("position", "velocity"),
    ) -> Windows:
        """Return all windows of `length` frames, for training; usable as a torch `Dataset`.

        Args:
            length: Number of frames in a window, history and target together.
            split: Part from which windows are taken; all if None.
            rows: Rows of the trajectories to take, or a mask of all rows; all if None.
            names: Datasets to take, one name or several, of frames or of steps; of both, the last
                frame is left out.

        Raises:
            InputError: A dataset has neither frames nor steps, or the length does not fit.
        """
        chosen = np.arange(len(self)) if split is None else self.rows_of(split)
        if rows is not None:
            chosen = np.intersect1d(chosen, np.arange(len(self))[rows])
        series = map(self._series, [names] if isinstance(names, str) else names)
        return Windows(tuple(series), chosen, length)


def _several(rows: Any) -> Any:
    return [rows] if isinstance(rows, int | np.integer) else rows


def labelled(arrays: Mapping[str, tuple[tuple[str, ...], Any]], **coordinates: Any) -> Any:
    """Return an `xarray.Dataset` of arrays, each with its axes, and the coordinates of these axes.

    Raises:
        InputError: xarray is not installed.
    """
    xarray = optional("xarray", "to_xarray()", "frames")
    used = {axis for axes, _ in arrays.values() for axis in axes}
    return xarray.Dataset(
        dict(arrays), coords={axis: coordinates[axis] for axis in coordinates if axis in used}
    )


def joined_files(path: Path, engines: str | None = None) -> list[Path]:
    """Return the files of the data sets in a folder, or the given file itself.

    Args:
        path: A data file, or a folder that `mbds-xsim generate` has made, or one within it.
        engines: Engines whose data sets are returned, comma-separated; all if None.

    Raises:
        InputError: There are no data sets, or none of an engine named.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    candidates = [path] if path.is_file() else variant_files(path, below=True)
    kinds = {file: attributes_of(file) for file in candidates}
    files = [file for file, attrs in kinds.items() if path.is_file() or attrs["kind"] == "joined"]
    if not files:
        msg = f"{path} holds no data set; name a folder that mbds-xsim generate has finished"
        raise InputError(msg)
    if engines is None:
        return files
    wanted = [word.strip() for word in engines.split(",")]
    available = sorted({str(kinds[file].get("engine")) for file in files})
    strange = [word for word in wanted if word not in available]
    if strange:
        msg = f"--engines: got {strange[0]!r}, allowed for {path} is {', '.join(available)}"
        raise InputError(msg)
    return [file for file in files if kinds[file].get("engine") in wanted]


def parse_numbers(text: str, option: str) -> list[int]:
    """Parse numbers and ranges, such as "0-9,15"; keep their order and repetitions.

    Raises:
        InputError: The text is something else, or has ranges that would fill the memory.
    """
    numbers: list[int] = []
    for word in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,15})(?:-(\d{1,15}))?\s*", word)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not 0 <= last - first < _LONGEST - len(numbers):
            raise InputError(
                f"{option}: got {text!r}, allowed are numbers and ranges of up to {_LONGEST}, as "
                "0-9,15"
            )
        numbers += range(first, last + 1)
    return numbers
