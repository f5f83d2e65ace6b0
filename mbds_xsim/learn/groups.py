"""The data to train on: engines that simulated the same starts, in groups of scene and variant.

A model trains on one engine, all but one, or all, always to one budget. Of several engines each
trajectory is taken from one, in turn: as many distinct trajectories as of a single engine, from the
same starts and in the same order, so that the same seed draws the same windows in every training.
One engine's starts of a single interval are for measuring an engine's shift by one that everybody
knows: they are a third as many, at as many steps.
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
from mbds_xsim.dataset.paired import check_alike, numbers_in
from mbds_xsim.dataset.read import Dataset, joined_files, load_dataset
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene

_SEVERAL = ("all", "leave-one-out")


@dataclass(frozen=True, eq=False)
class TrainingGroup:
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
        about = next(iter(self.data.values())).attributes
        return {"seed": int(about["seed"]), "trajectories": int(about["count"])}

    def __getstate__(self) -> dict[str, object]:
        """Leave open files behind when it goes to another process."""
        return {key: value for key, value in vars(self).items() if key != "data"}

    def numbers(self, split: str) -> Index:
        """Index of the trajectories of a part that every engine of the group has, ascending."""
        return numbers_in([*self.data.values()], split)


def groups(paths: Sequence[Path]) -> list[TrainingGroup]:
    """Find data sets, and put together those of one scene and one variant.

    InputError says what is missing, or which files do not belong together.
    """
    files = dict.fromkeys(file.resolve() for path in paths for file in joined_files(path))
    by_group: dict[tuple[str, str], dict[str, Dataset]] = {}
    for file in files:
        data = load_dataset(file)
        about = data.attributes
        engines = by_group.setdefault((about["scene_name"], about["profile"]), {})
        if about["engine"] in engines:
            msg = (
                f"{engines[about['engine']].path} and {file} are both {about['scene_name']} of "
                f"{about['engine']} {about['profile']}; give one of them"
            )
            raise InputError(msg)
        engines[about["engine"]] = data
    made = [_group(*key, dict(sorted(each.items()))) for key, each in sorted(by_group.items())]
    for group in made:
        _check(group)
    return made


def _group(scene: str, variant: str, engines: Mapping[str, Dataset]) -> TrainingGroup:
    lacking = {engine: data.lack for engine, data in engines.items() if data.lack}
    files = {engine: data.path for engine, data in engines.items() if engine not in lacking}
    if not files:
        msg = "; ".join(f"{engines[engine].path}: {lack}" for engine, lack in lacking.items())
        raise InputError(f"{msg}; generate other data")
    return TrainingGroup(scene, variant, files, lacking)


def _check(group: TrainingGroup) -> None:
    check_alike([*group.data.values()])
    frames = int(next(iter(group.data.values())).attributes["steps"]) + 1
    for split in ("train", "validation"):
        if not len(group.numbers(split)) or frames <= HISTORY:
            where = ", ".join(str(file.path) for file in group.data.values())
            msg = (
                f"{where}: {len(group.numbers(split))} trajectories of {frames} frames for "
                f"{split} that all engines have, needed are at least 1 of {HISTORY + 1}; "
                "generate more"
            )
            raise InputError(msg)


@dataclass(frozen=True)
class Share:
    """The part of a group that a training has."""

    engines: tuple[str, ...]
    interval: str = ""
    """Of the starts: low, medium or high; all when left out."""

    def numbers(self, group: TrainingGroup, split: str) -> Index:
        """Index of the trajectories of a part, ascending."""
        numbers = group.numbers(split)
        if not self.interval:
            return numbers
        return numbers[numbers % len(INTERVALS) == INTERVALS.index(self.interval)]


def shares_of(group: TrainingGroup, on: str) -> dict[str, Share]:
    """Give what each training has, by its name: `mujoco`, `not-mujoco`, `all`, `mujoco-low`.

    `on` is `each`, `leave-one-out`, `all`, `by-interval`, or names of those of single engines, by
    commas; InputError says what else it might be.
    """
    engines = tuple(group.files)
    single = {engine: Share((engine,)) for engine in engines}
    parts = {f"{e}-{interval}": Share((e,), interval) for e in engines for interval in INTERVALS}
    ways = {
        "each": single,
        "leave-one-out": {f"not-{e}": Share(tuple(o for o in engines if o != e)) for e in engines},
        "all": {"all": Share(engines)},
        "by-interval": parts,
        **{engine: {engine: share} for engine, share in single.items()},
    }
    known = ", ".join(ways)
    ways |= {name: {name: share} for name, share in parts.items()}
    shares: dict[str, Share] = {}
    for word in (word.strip() for word in on.split(",")):
        if word not in ways:
            msg = (
                f"--on: got {word!r}, allowed for {group.name} is {known}, or an engine's starts "
                f"of an interval, as {next(iter(parts))}"
            )
            raise InputError(msg)
        if word in _SEVERAL and len(engines) < 2:
            msg = (
                f"--on: {word} needs data of at least 2 engines, {group.name} has {engines[0]} "
                "only; give more data, or --on each"
            )
            raise InputError(msg)
        shares |= ways[word]
    return shares


def turns(numbers: Index, count: int) -> Index:
    """Which of so many engines each trajectory is taken from.

    The interval of speed is the number modulo 3, so whole triples are taken in turn: with three
    engines each would otherwise be seen at one speed only.
    """
    return numbers // len(INTERVALS) % count


def check_share(group: TrainingGroup, share: Share, split: str) -> None:
    """Refuse a training, by InputError, without any trajectory of a part."""
    if not len(share.numbers(group, split)):
        msg = (
            f"{group.name}: no trajectory of {split} is of the interval {share.interval!r}; "
            "generate more"
        )
        raise InputError(msg)


def mixed(
    group: TrainingGroup, share: Share, split: str, *, most: int | None = None, **how: Any
) -> Motions:
    """Read a part of a training's data, in ascending order of the trajectories' numbers.

    Only trajectories that every engine of the group has are taken, at most so many; of the rest see
    `Motions.of`.
    """
    check_share(group, share, split)
    numbers = share.numbers(group, split)[:most]
    turn = turns(numbers, len(share.engines))
    parts = []
    for k, engine in enumerate(share.engines):
        data = group.data[engine]
        rows = np.flatnonzero(np.isin(data.index, numbers[turn == k]))
        if len(rows):
            part = Motions.of(data, split, rows=rows, **how)
            parts.append(part)
    if len(parts) == 1:
        return parts[0]  # no copy of what may fill the memory; files are in ascending order
    whole = Motions.joined(parts)
    return whole[torch.from_numpy(np.argsort(whole.index))]
