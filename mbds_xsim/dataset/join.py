"""Join shards: one virtual file a variant, and one that says what is valid in all of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.files import put
from mbds_xsim.dataset.hdf5 import CONTENT, NewFile, encode, open_hdf5, values_of
from mbds_xsim.dataset.layout import FIELDS, SHARED, SUFFIX, Field, split_of
from mbds_xsim.dataset.shard import rejected_folder
from mbds_xsim.dataset.variant import Variant

JOINT = f"joint{SUFFIX}"
"""Name of the file that says which trajectories are valid in all variants of a scene."""


@dataclass(frozen=True)
class VariantCount:
    """What came of one variant."""

    scene: str
    variant: str
    file: str
    trajectories: int
    published: int
    rejected: int
    rejected_by: dict[str, int]
    """By the check that failed first."""
    bytes: int


def join(variants: Sequence[Variant], trajectories: int, out: Path) -> Iterator[VariantCount]:
    """Write the joined file of every variant, and the joint file of every scene."""
    for variant in variants:
        yield _join_variant(variant, trajectories, out)
    for folder in dict.fromkeys(variant.folder(out).parent for variant in variants):
        _join_scene(folder)


def _join_variant(variant: Variant, trajectories: int, out: Path) -> VariantCount:
    folder = variant.folder(out)
    names = [item.file_name for item in variant.items(trajectories)]
    shards = [_Shard(folder / name) for name in names]
    published = sum(shard.rows for shard in shards)
    facts = {
        "kind": "joined",
        "first": 0,
        "count": trajectories,
        "published": published,
        "rejected": trajectories - published,
    }
    target = folder.with_name(f"{variant.name}{SUFFIX}")
    put(target, _joined(shards, trajectories, {**variant.recipe, **facts}))
    return VariantCount(
        scene=variant.scene.name,
        variant=variant.name,
        file=str(target.relative_to(out)),
        trajectories=trajectories,
        published=published,
        rejected=trajectories - published,
        rejected_by=dict(causes(rejected_folder(variant, out), names).most_common()),
        bytes=sum(shard.path.stat().st_size for shard in shards),
    )


def _joined(shards: Sequence[_Shard], trajectories: int, attributes: dict[str, Any]) -> bytes:
    """The bytes of a file that finds the trajectories of all shards; they stay where they are."""
    index = np.concatenate([shard.index for shard in shards])
    own = {
        "index": index,
        "split": split_of(index, trajectories),
        "shard/file": np.array([f"{shard.path.parent.name}/{shard.path.name}" for shard in shards]),
        "shard/rows": np.array([shard.rows for shard in shards]),
        "shard/content": np.array([shard.content for shard in shards]),
    }
    with NewFile() as new, open_hdf5(shards[0].path) as first:
        for name in sorted(own.keys() | {name for name in FIELDS if name in first}):
            if name in own:
                new.put(FIELDS[name], own[name])
            elif FIELDS[name].per_trajectory:
                _put_virtual(new, FIELDS[name], first[name], shards)
            else:
                new.put(FIELDS[name], values_of(first[name]))
        return new.finished(attributes)


class _Shard:
    """What joining needs of a shard."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_hdf5(path) as file:
            self.index: NDArray[np.int64] = file["index"][()]
            self.content = str(file.attrs[CONTENT])
        self.rows = len(self.index)


def _put_virtual(new: NewFile, field: Field, like: Any, shards: Sequence[_Shard]) -> None:
    """Put a dataset that reads from the shards; where one is missing it has no numbers."""
    total = sum(shard.rows for shard in shards)
    space = h5py.h5s.create_simple((total, *like.shape[1:]))
    # Low level, because `create_virtual_dataset` puts the time of the day into the file.
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    creation.set_obj_track_times(False)
    fill = {"f": np.nan, "u": 255, "i": -1}[like.dtype.kind]
    creation.set_fill_value(np.array([fill], dtype=like.dtype))
    first = 0
    for shard in shards:
        if shard.rows:
            shape = (shard.rows, *like.shape[1:])
            space.select_hyperslab((first,) + (0,) * (len(shape) - 1), shape)
            path = f"{shard.path.parent.name}/{shard.path.name}".encode()
            creation.set_virtual(space, path, field.name.encode(), h5py.h5s.create_simple(shape))
        first += shard.rows
    space.select_all()
    new.hdf5.require_group(field.name.rpartition("/")[0] or "/")
    kind = h5py.h5t.py_create(like.dtype)
    h5py.h5d.create(new.hdf5.id, field.name.encode(), kind, space, dcpl=creation)
    new.describe(field, {})


def causes(folder: Path, names: Sequence[str]) -> Counter[str]:
    """Count rejected trajectories by what failed first."""
    found: Counter[str] = Counter()
    for name in names:
        if (folder / name).exists():
            with open_hdf5(folder / name) as file:
                found.update(map(cause_of, file["reason"].asstr()[()]))
    return found


def cause_of(reason: str) -> str:
    """Give what failed first, whenever it did."""
    return re.sub(r"^ended at frame \d+$", "ended early", reason.split(":")[0])


def valid_numbers(path: Path) -> NDArray[np.bool_]:
    """Tell of each number that was drawn whether a joined file has its trajectory."""
    with open_hdf5(path) as file:
        return np.isin(np.arange(file.attrs["count"]), file["index"][()])


def _join_scene(folder: Path) -> None:
    """Write which trajectories are published in all variants that a folder holds."""
    paths = [path for path in sorted(folder.glob(f"*{SUFFIX}")) if path.name != JOINT]
    masks = [valid_numbers(path) for path in paths]
    with open_hdf5(paths[0]) as file:
        shared = {key: file.attrs[key] for key in SHARED}
    common = min(map(len, masks))
    valid = np.stack([mask[:common] for mask in masks])
    datasets = {
        "variant": np.array([path.stem for path in paths]),
        "valid": valid,
        "valid_in_all": np.asarray(valid.all(axis=0)),
    }
    put(folder / JOINT, encode(datasets, {**shared, "kind": "joint", "count": common}))
