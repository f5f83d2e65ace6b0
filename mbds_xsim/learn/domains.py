"""The data to train on: engines that simulated the same starts, in groups of scene and variant."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.found import joined_files
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.errors import InputError
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.scene import Scene

__all__ = ["Group", "groups"]

Numbers = NDArray[np.int64]

_ALIKE = {
    "scene": "scene",
    "seed": "seed",
    "noise": "noise",
    "count": "number of trajectories drawn",
}
_NEEDED = ("train", "validation")


@dataclass(frozen=True, eq=False)
class Group:
    """A scene in a variant of the engines' settings: each engine is a domain."""

    scene_name: str
    variant: str
    """`native` or `matched`."""
    files: Mapping[str, Path]
    """Of each engine, by name."""
    left_out: Mapping[str, str]
    """Engines of whose trajectories none were published, with the reason."""

    @property
    def name(self) -> str:
        """As in `6pendulum/native`."""
        return f"{self.scene_name}/{self.variant}"

    @property
    def scene(self) -> Scene:
        """The scene, the same in all files."""
        return next(iter(self.data.values())).scene

    @functools.cached_property
    def data(self) -> dict[str, Dataset]:
        """The open files, by engine."""
        return {engine: load_dataset(path) for engine, path in self.files.items()}

    @property
    def drawn(self) -> dict[str, int]:
        """What the split depends on: the seed, and the number of trajectories drawn."""
        told = next(iter(self.data.values())).attributes
        return {"seed": int(told["seed"]), "trajectories": int(told["count"])}

    def __getstate__(self) -> dict[str, object]:
        """Leave open files behind when it goes to another process."""
        return {key: value for key, value in vars(self).items() if key != "data"}

    def numbers(self, split: str) -> Numbers:
        """Numbers of the trajectories of a part that every engine of the group has, ascending."""
        each = [data.index[data.rows_of(split)] for data in self.data.values()]
        return functools.reduce(np.intersect1d, each)


def groups(paths: Sequence[Path]) -> list[Group]:
    """Find data sets, and put together those of one scene and one variant.

    Raises:
        InputError: There are none, one has nothing to train on, two are of one engine, or two of
            one group do not have the same starts.
    """
    files = dict.fromkeys(file.resolve() for path in paths for file in joined_files(path))
    found: dict[tuple[str, str], dict[str, Dataset]] = {}
    for file in files:
        data = load_dataset(file)
        told = data.attributes
        engines = found.setdefault((told["scene_name"], told["profile"]), {})
        if told["engine"] in engines:
            msg = (
                f"{engines[told['engine']].path} and {file} are both {told['scene_name']} of "
                f"{told['engine']} {told['profile']}; give one of them"
            )
            raise InputError(msg)
        engines[told["engine"]] = data
    made = [_group(*key, dict(sorted(engines.items()))) for key, engines in sorted(found.items())]
    for group in made:
        _check(group)
    return made


def _group(scene: str, variant: str, engines: Mapping[str, Dataset]) -> Group:
    lacking = {engine: data.lack for engine, data in engines.items() if data.lack}
    files = {engine: data.path for engine, data in engines.items() if engine not in lacking}
    if not files:
        msg = "; ".join(f"{engines[engine].path}: {lack}" for engine, lack in lacking.items())
        raise InputError(f"{msg}; generate other data")
    return Group(scene, variant, files, lacking)


def _check(group: Group) -> None:
    (first, data), *others = group.data.items()
    for engine, other in others:
        for key, words in _ALIKE.items():
            if data.attributes[key] != other.attributes[key]:
                msg = (
                    f"{group.name}: the {words} of {engine} is not that of {first}, so their "
                    f"trajectories cannot be paired ({other.path}, {data.path}); give data that "
                    "were generated together"
                )
                raise InputError(msg)
    frames = int(data.attributes["steps"]) + 1
    for split in _NEEDED:
        if not len(group.numbers(split)) or frames <= HISTORY:
            where = ", ".join(str(file.path) for file in group.data.values())
            msg = (
                f"{where}: {len(group.numbers(split))} trajectories of {frames} frames for "
                f"{split} that all engines have, needed are at least 1 of {HISTORY + 1}; "
                "generate more"
            )
            raise InputError(msg)
