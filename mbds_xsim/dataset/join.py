"""Join shards: one virtual file a variant, and one that says what is valid in all of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.files import put
from mbds_xsim.dataset.hdf5 import CONTENT, Virtual, encode, open_hdf5, values_of
from mbds_xsim.dataset.layout import (
    FIELDS,
    JOINT,
    SHARED,
    SUFFIX,
    rejected_folder,
    split_of,
    variant_files,
)
from mbds_xsim.dataset.variant import Variant


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
    shards = [Shard(folder / name) for name in names]
    published = sum(len(shard.index) for shard in shards)
    facts = {
        "kind": "joined",
        "first": 0,
        "count": trajectories,
        "published": published,
        "rejected": trajectories - published,
    }
    target = folder.with_name(f"{variant.name}{SUFFIX}")
    put(target, joined(shards, trajectories, {**variant.recipe, **facts}))
    return VariantCount(
        scene=variant.scene.name,
        variant=variant.name,
        file=str(target.relative_to(out)),
        trajectories=trajectories,
        published=published,
        rejected=trajectories - published,
        rejected_by=dict(causes(rejected_folder(folder), names).most_common()),
        bytes=sum(shard.path.stat().st_size for shard in shards),
    )


def joined(shards: Sequence[Shard], trajectories: int, attributes: dict[str, Any]) -> bytes:
    """The bytes of a file that finds the trajectories of all shards; they stay where they are."""
    index = np.concatenate([shard.index for shard in shards])
    rows = [(f"{shard.path.parent.name}/{shard.path.name}", len(shard.index)) for shard in shards]
    with open_hdf5(shards[0].path) as first:
        datasets: dict[str, NDArray[Any] | Virtual] = {
            name: Virtual(np.empty((0, *first[name].shape[1:]), first[name].dtype), rows)
            if field.per_trajectory
            else values_of(first[name])
            for name, field in FIELDS.items()
            if name in first
        }
    datasets |= {
        "index": index,
        "split": split_of(index, trajectories),
        "shard/file": np.array([name for name, _ in rows]),
        "shard/rows": np.array([count for _, count in rows]),
        "shard/content": np.array([shard.content for shard in shards]),
    }
    return encode(datasets, attributes)


class Shard:
    """What joining needs of a shard."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_hdf5(path) as file:
            self.index: NDArray[np.int64] = file["index"][()]
            self.content = str(file.attrs[CONTENT])


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


def _join_scene(folder: Path) -> None:
    """Write which trajectories are published in all variants that a folder holds."""
    with open_hdf5(variant_files(folder)[0]) as file:
        shared = {key: file.attrs[key] for key in SHARED}
    datasets = joint_datasets(folder)
    count = len(datasets["valid_in_all"])
    put(folder / JOINT, encode(datasets, {**shared, "kind": "joint", "count": count}))


def joint_datasets(folder: Path) -> dict[str, NDArray[Any]]:
    """Find which of the trajectories that were drawn are published in each variant, and in all."""
    paths = variant_files(folder)
    masks = [_published(path) for path in paths]
    common = min(map(len, masks))
    valid = np.stack([mask[:common] for mask in masks])
    return {
        "variant": np.array([path.stem for path in paths]),
        "valid": valid,
        "valid_in_all": np.asarray(valid.all(axis=0)),
    }


def _published(path: Path) -> NDArray[np.bool_]:
    """Tell of each number that was drawn whether a joined file has its trajectory."""
    with open_hdf5(path) as file:
        return np.isin(np.arange(file.attrs["count"]), file["index"][()])
