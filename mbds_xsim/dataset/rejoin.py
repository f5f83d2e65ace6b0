"""Check the files that join shards: do they find what they say, all of it, once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.dataset.content import CONTENT, check_content, values_of
from mbds_xsim.dataset.facts import attributes_of
from mbds_xsim.dataset.join import JOINT, valid_numbers
from mbds_xsim.dataset.layout import SUFFIX, known_names
from mbds_xsim.dataset.opened import opened
from mbds_xsim.dataset.reaudit import FileReport
from mbds_xsim.dataset.split import NAMES, split_of
from mbds_xsim.errors import InputError

__all__ = ["recheck_joined", "recheck_joint"]

_OWN = ("kind", "first", "count", "published", "rejected", CONTENT)
"""Attributes that a joined file does not share with its shards."""


def recheck_joined(path: Path) -> FileReport:
    """Check a file that joins the shards of a variant; the shards themselves are not looked at."""
    try:
        wrong = check_content(path)
        if wrong is not None:
            return FileReport(str(path), "joined", 0, (f"checksum: {wrong}",))
        told = attributes_of(path)
        with opened(path) as file:
            problems = (*_parts(path, file, told), *_virtual(file))
            index = file["index"][()]
            if not np.array_equal(file["split"][()], split_of(index, told["count"])):
                problems = (*problems, "split: not the one of the index")
            notes = (_parts_of(file["split"][()]),)
            problems = (*problems, *_rejected(path, index, told))
    except (InputError, OSError, KeyError, ValueError, RuntimeError) as error:
        return FileReport(str(path), "joined", 0, (f"cannot be read: {error}",))
    return FileReport(str(path), "joined", len(index), problems, notes)


def _parts_of(split: Any) -> str:
    counts = np.bincount(split, minlength=len(NAMES))
    return ", ".join(f"{name} {count}" for name, count in zip(NAMES, counts, strict=True))


def _parts(path: Path, file: Any, told: dict[str, Any]) -> Iterator[str]:
    """Its shards must be there, be the ones that were joined, and make up its index."""
    found = []
    names, rows = values_of(file["shard/file"]), file["shard/rows"][()]
    for name, count, content in zip(names, rows, values_of(file["shard/content"]), strict=True):
        part = path.parent / name
        if not part.is_file():
            yield f"shard {name} is missing"
            continue
        other = attributes_of(part)
        if other.get(CONTENT) != content:
            yield f"shard {name} is not the one that was joined"
        differing = [k for k in told if k not in _OWN and other.get(k) != told[k]]
        if differing:
            yield f"shard {name} was made otherwise: {', '.join(differing)}"
        with opened(part) as shard:
            found.append(shard["index"][()])
        if len(found[-1]) != count:
            yield f"shard {name} has {len(found[-1])} trajectories, not {count}"
    index = file["index"][()]
    if not found or not np.array_equal(np.concatenate(found), index):
        yield "index: not that of the shards"
    if told["published"] != len(index) or told["published"] + told["rejected"] != told["count"]:
        yield "counts: published and rejected do not make up count"


def _rejected(path: Path, index: Any, told: dict[str, Any]) -> Iterator[str]:
    """What is published and what is rejected must make up what was drawn, each once."""
    folder = path.parents[1] / "rejected" / path.parent.name / path.stem
    if not folder.is_dir():
        return
    found = [index]
    for part in sorted(folder.glob(f"*{SUFFIX}")):
        with opened(part) as file:
            found.append(file["index"][()])
    if not np.array_equal(np.sort(np.concatenate(found)), np.arange(told["count"])):
        yield f"published and rejected trajectories do not make up 0 to {told['count'] - 1}"


def _virtual(file: Any) -> Iterator[str]:
    """Every dataset must take its rows from the shards, in order."""
    names, rows = values_of(file["shard/file"]), file["shard/rows"][()]
    ends = np.cumsum(rows)
    wanted = [
        (name, int(end - count), int(end) - 1)
        for name, count, end in zip(names, rows, ends, strict=True)
        if count
    ]
    for field in known_names().values():
        if not field.per_trajectory or field.name in ("index", "split") or field.name not in file:
            continue
        dataset = file[field.name]
        if not dataset.is_virtual or len(dataset) != ends[-1]:
            yield f"{field.name}: does not join the shards"
        elif dataset.dtype != np.dtype(field.dtype):
            yield f"{field.name}: has the type {dataset.dtype}, not {field.dtype}"
        elif 0 not in dataset.shape and _sources(dataset) != wanted:
            yield f"{field.name}: takes its rows from elsewhere than the shards"


def _sources(dataset: Any) -> list[tuple[str, int, int]]:
    """File, first and last row of each source; empty where one is not a whole dataset."""
    found = []
    for source in dataset.virtual_sources():
        low, high = source.vspace.get_select_bounds()
        whole = (*low[1:], *high[1:]) == (
            *(0,) * (dataset.ndim - 1),
            *(n - 1 for n in dataset.shape[1:]),
        )
        if not whole or f"/{source.dset_name}".replace("//", "/") != dataset.name:
            return []
        found.append((source.file_name, low[0], high[0]))
    return found


def recheck_joint(path: Path) -> FileReport:
    """Check which trajectories are said to be valid in all variants beside a file."""
    try:
        wrong = check_content(path)
        if wrong is not None:
            return FileReport(str(path), "joint", 0, (f"checksum: {wrong}",))
        with opened(path) as file:
            valid, told = file["valid"][()], values_of(file["variant"]).tolist()
            in_all = file["valid_in_all"][()]
        problems = tuple(_valid(path, valid, told))
        if not np.array_equal(in_all, valid.all(axis=0)):
            problems = (*problems, "valid_in_all: not what the variants have in common")
    except (InputError, OSError, KeyError, ValueError, RuntimeError) as error:
        return FileReport(str(path), "joint", 0, (f"cannot be read: {error}",))
    return FileReport(str(path), "joint", int(in_all.sum()), problems)


def _valid(path: Path, valid: Any, told: list[str]) -> Iterator[str]:
    beside = sorted(p for p in path.parent.glob(f"*{SUFFIX}") if p.name != JOINT)
    if [other.stem for other in beside] != told:
        yield f"is about {', '.join(told)}; beside it are {', '.join(p.stem for p in beside)}"
        return
    for other, stored in zip(beside, valid, strict=True):
        if not np.array_equal(valid_numbers(other)[: len(stored)], stored):
            yield f"valid: not what {other.name} holds"
