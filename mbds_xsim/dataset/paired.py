"""Trajectories with the same starts in several engines, paired by number: only engines differ."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Index
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import path_of
from mbds_xsim.dataset.layout import FIELDS
from mbds_xsim.dataset.read import Dataset, joined_files, labelled, load_dataset
from mbds_xsim.dataset.series import PairedSeries, Series
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES

STARTS = tuple(f"start/{name}" for name in STATES)
_SAME = ("scene", "seed", "noise", "frame_s", "steps", "count")


@dataclass(frozen=True, eq=False, repr=False)
class PairedData:
    """Trajectories that several data sets of a scene have in common, matched by their number.

    `pairs["position"]` and other series of trajectories are `PairedSeries`; a dataset that is the
    same in all files, such as `pairs["time"]`, is an array. `len(pairs)` counts trajectories.
    """

    files: dict[str, Dataset]
    """Data sets by engine and settings, as in `mujoco-matched`, in the order of axis `engine`."""
    index: Index
    """Number of each trajectory, ascending."""

    def __len__(self) -> int:
        return len(self.index)

    def __repr__(self) -> str:
        return f"<{self.scene.name}: {len(self)} trajectories in {', '.join(self.files)}>"

    @property
    def scene(self) -> Scene:
        """The scene, the same in all files."""
        return self._first.scene

    @functools.cached_property
    def rows(self) -> tuple[Index, ...]:
        """Row of each trajectory in each file."""
        return tuple(np.flatnonzero(np.isin(one.index, self.index)) for one in self.files.values())

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._first if all(name in one for one in self.files.values()))

    def __getitem__(self, name: str) -> PairedSeries | NDArray[Any]:
        """Return a dataset of all engines by its path in the files.

        Raises:
            UnknownDataset: A file has no dataset of this name.
        """
        values = [one[name] for one in self.files.values()]
        series = tuple(value for value in values if isinstance(value, Series))
        if series:
            return PairedSeries.of(series, self.rows)
        whole = np.asarray(values[0])
        return whole[self.rows[0]] if FIELDS[name].per_trajectory else whole

    def to_xarray(self, names: str | Sequence[str] = ("position", "velocity")) -> Any:
        """Read datasets into an `xarray.Dataset` with the axes of the layout, and `engine`.

        Args:
            names: Datasets to read: one name or several.

        Raises:
            UnknownDataset: A file has no dataset of one of these names.
            InputError: xarray is not installed.
        """
        arrays = {}
        for name in [names] if isinstance(names, str) else names:
            values = self[name]  # refuses unknown names
            axes = FIELDS[name].axes
            if isinstance(values, PairedSeries):
                axes = (axes[0], "engine", *axes[1:])
            arrays[name] = (axes, values[:])
        return labelled(arrays, trajectory=self.index, frame=self["time"], engine=[*self.files])

    @property
    def _first(self) -> Dataset:
        return next(iter(self.files.values()))


def load_pairs(*paths: str | Path, split: str | None = None) -> PairedData:
    """Pair data sets of one scene: trajectories that all have, with the same starts and inputs.

    Only indices and starts are read now; series are read when they are used.

    Args:
        paths: Data files, or folders of them such as `data/6pendulum`. Of a folder, data sets in
            which nothing is published are left out.
        split: Part to load: "train", "validation" or "test"; all if None.

    Raises:
        InputError: There are fewer than two data sets, or they do not belong together: scene,
            seed, length or starts differ, or no trajectory is in all of them.
    """
    places = [path_of("paths", path) for path in paths]
    found = [load_dataset(file) for place in places for file in joined_files(place)]
    sets = [one for one in found if not one.lack or one.path in places]
    lacks = "; ".join(f"{one.path}: {one.lack}" for one in found if one.lack)
    source = ", ".join(map(str, paths)) or "paths"
    files = {one.variant: one for one in sets}
    if len(sets) < 2 or len(files) < len(sets):
        names = ", ".join(str(one.path) for one in sets)
        msg = (
            f"{source}: got {names or 'none'}, pairing takes two or more data sets, each of another"
        )
        raise InputError(f"{msg} engine or settings" + (f"; {lacks}" if lacks else ""))
    check_alike(sets)
    index = numbers_in(sets, split)
    if not len(index):
        part = f"{split} trajectory" if split else "trajectory"
        msg = f"no {part} is valid in all {len(files)} data sets; generate more"
        raise InputError(f"{lacks or source}: {msg}")
    pairs = PairedData(files, index)
    check_paired(sets, pairs.rows, STARTS)
    return pairs


def numbers_in(files: Sequence[Dataset], split: str | None) -> Index:
    """Return the numbers of the trajectories that all files have (in a part), ascending."""
    each = [one.index if split is None else one.index[one.rows_of(split)] for one in files]
    return functools.reduce(np.intersect1d, each)


def check_alike(files: Sequence[Dataset]) -> None:
    """Raise InputError unless all files have the same scene, draws and length."""
    first = files[0]
    for file in files[1:]:
        for key in _SAME:
            own, other = file.attributes[key], first.attributes[key]
            if own != other:
                mismatch = f"{key} {own}, unlike {first.path.name} ({other})"
                if key == "scene":
                    mismatch = f"another scene, unlike {first.path.name}"
                raise InputError(
                    f"{file.path}: {mismatch}; domains must be the same motions, generate them "
                    "in one run"
                )


def check_paired(files: Sequence[Dataset], rows: Sequence[Index], names: Sequence[str]) -> None:
    """Raise InputError unless datasets are equal to the last bit: only the engine may differ."""
    for name in names:
        first = np.asarray(files[0][name][rows[0]])
        for file, chosen in zip(files[1:], rows[1:], strict=True):
            same = (file[name][chosen] == first).reshape(len(first), -1).all(axis=1)
            if not same.all():
                number = file.index[chosen[np.flatnonzero(~same)[0]]]
                raise InputError(
                    f"{file.path}: {name} of trajectory {number} is not that of "
                    f"{files[0].path.name}; the domains are not paired, generate them in one run"
                )
