"""Training data: engines that simulated the same starts, grouped by scene and variant.

A model trains on one engine, all but one, or all, always with the same budget. With several engines
each trajectory is taken from one of them in turn: as many distinct trajectories as of one engine,
with the same starts in the same order, so the same seed draws the same windows in every training.
Trainings on one engine's starts of a single interval give a known shift to compare the shift of
engines with. They have a third as many trajectories, but as many steps.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mbds_xsim.base.arrays import Index
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import counted
from mbds_xsim.dataset.paired import check_alike, numbers_in
from mbds_xsim.dataset.read import Dataset, joined_files, load_dataset
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene

_SEVERAL = ("all", "leave-one-out")


@dataclass(frozen=True, eq=False)
class TrainingGroup:
    """Data of a scene in one variant of the engines' settings; each engine is a domain."""

    scene_name: str
    variant: str
    """Profile of the settings: `native`, `matched` or that of a settings file."""
    files: Mapping[str, Path]
    """Data file of each engine that published a trajectory, by engine name; there may be none."""
    left_out: Mapping[str, str]
    """Engines without any published trajectory, with the reason."""

    @property
    def name(self) -> str:
        """Name of scene and variant, as in `6pendulum/native`."""
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
        """Seed and number of the trajectories drawn, on which the split depends."""
        about = next(iter(self.data.values())).attributes
        return {"seed": int(about["seed"]), "trajectories": int(about["count"])}

    def __getstate__(self) -> dict[str, object]:
        """Leave out open files when the group is sent to another process."""
        return {key: value for key, value in vars(self).items() if key != "data"}

    def numbers(self, split: str) -> Index:
        """Return the numbers of a part's trajectories that all engines have, ascending."""
        return numbers_in([*self.data.values()], split)


def groups(paths: Sequence[Path]) -> list[TrainingGroup]:
    """Find data sets and group them by scene and variant.

    Raises InputError if data are missing, or if files do not belong together.
    """
    files = dict.fromkeys(file.resolve() for path in paths for file in joined_files(path))
    by_group: dict[tuple[str, str], dict[str, Dataset]] = {}
    for file in files:
        data = load_dataset(file)
        about = data.attributes
        engines = by_group.setdefault((about["scene_name"], about["profile"]), {})
        if about["engine"] in engines:
            raise InputError(
                f"{engines[about['engine']].path} and {file} are both {about['scene_name']} of "
                f"{about['engine']} {about['profile']}; give one of them"
            )
        engines[about["engine"]] = data
    result = []
    for key, each in sorted(by_group.items()):
        lacking = {engine: data.lack for engine, data in sorted(each.items()) if data.lack}
        usable = {e: data.path for e, data in sorted(each.items()) if not data.lack}
        result.append(TrainingGroup(*key, usable, lacking))
    full = [group for group in result if group.files]
    if result and not full:
        lacks = [
            f"{data.path}: {data.lack}" for each in by_group.values() for data in each.values()
        ]
        raise InputError(f"{'; '.join(lacks)}; generate other data")
    for group in full:
        _check(group)
    return result


def _check(group: TrainingGroup) -> None:
    check_alike([*group.data.values()])
    frames = int(next(iter(group.data.values())).attributes["steps"]) + 1
    for split in ("train", "validation"):
        if not len(group.numbers(split)) or frames <= HISTORY:
            paths = ", ".join(str(file.path) for file in group.data.values())
            got = counted(len(group.numbers(split)), "trajectory")
            raise InputError(
                f"{paths}: {got} of {frames} frames for {split} that all engines have, "
                f"needed are at least 1 of {HISTORY + 1}; generate more"
            )


@dataclass(frozen=True)
class Share:
    """Part of a group's data that a training uses."""

    engines: tuple[str, ...]
    interval: str = ""
    """Interval of the starts: low, medium or high; empty for all."""

    def numbers(self, group: TrainingGroup, split: str) -> Index:
        """Return the numbers of the trajectories of a part, ascending."""
        numbers = group.numbers(split)
        if not self.interval:
            return numbers
        return numbers[numbers % len(INTERVALS) == INTERVALS.index(self.interval)]


def shares_of(group: TrainingGroup, on: str) -> dict[str, Share]:
    """Return the share of each training, by its name: `mujoco`, `not-mujoco`, `all`, `mujoco-low`.

    `on` has words separated by commas: `each`, `leave-one-out`, `all`, `by-interval`, and names of
    trainings on single engines. Raises InputError with the allowed words for any other.
    """
    engines = tuple(group.files)
    single = {engine: Share((engine,)) for engine in engines}
    parts = {f"{e}-{interval}": Share((e,), interval) for e in engines for interval in INTERVALS}
    choices = {
        "each": single,
        "leave-one-out": {f"not-{e}": Share(tuple(o for o in engines if o != e)) for e in engines},
        "all": {"all": Share(engines)},
        "by-interval": parts,
        **{engine: {engine: share} for engine, share in single.items()},
    }
    allowed = ", ".join(choices)
    choices |= {name: {name: share} for name, share in parts.items()}
    shares: dict[str, Share] = {}
    for word in (word.strip() for word in on.split(",")):
        if word not in choices:
            raise InputError(
                f"--on: got {word!r}, allowed for {group.name} is {allowed}, or an engine's starts "
                f"of an interval, as {next(iter(parts))}"
            )
        if word in _SEVERAL and len(engines) < 2:
            raise InputError(
                f"--on: {word} needs data of at least 2 engines, {group.name} has {engines[0]} "
                "only; give more data, or --on each"
            )
        shares |= choices[word]
    return shares


def turns(numbers: Index, count: int) -> Index:
    """Return which of `count` engines each trajectory is taken from.

    The interval of speed is the number modulo 3, so engines take turns at whole triples: three
    engines would otherwise be seen at one speed each.
    """
    return numbers // len(INTERVALS) % count


def check_share(group: TrainingGroup, share: Share, split: str) -> None:
    """Raise InputError if a training has no trajectory of a part."""
    if not len(share.numbers(group, split)):
        raise InputError(
            f"{group.name}: no trajectory of {split} is of the interval {share.interval!r}; "
            "generate more"
        )


def mixed(
    group: TrainingGroup, share: Share, split: str, *, most: int | None = None, **options: Any
) -> Motions:
    """Read a part of a training's data, in ascending order of the trajectories' numbers.

    Only trajectories that every engine of the group has are taken, at most `most`; `options` go
    to `Motions.of`.
    """
    check_share(group, share, split)
    numbers = share.numbers(group, split)[:most]
    turn = turns(numbers, len(share.engines))
    parts = []
    for k, engine in enumerate(share.engines):
        data = group.data[engine]
        rows = np.flatnonzero(np.isin(data.index, numbers[turn == k]))
        if len(rows):
            parts.append(Motions.of(data, split, rows=rows, **options))
    if len(parts) == 1:
        return parts[0]  # no copy of what may fill the memory; files are in ascending order
    motions = Motions.joined(parts)
    return motions[torch.from_numpy(np.argsort(motions.index))]
