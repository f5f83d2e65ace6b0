"""What a data set is and holds, from its files."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.join import cause_of, causes
from mbds_xsim.dataset.layout import ATTRIBUTES, SPLITS, rejected_folder
from mbds_xsim.dataset.read import Dataset, joined_files, load_dataset
from mbds_xsim.scene.sampling_terms import INTERVALS


@dataclass(frozen=True)
class Range:
    """What a check finds over a data set."""

    check: str
    unit: str
    trajectories: int
    """Of which it has a figure."""
    smallest: float
    median: float
    largest: float
    allowed: float | None
    """The least that is allowed of any; None: shown, not judged."""


@dataclass(frozen=True)
class Summary:
    """A data set in brief."""

    file: str
    kind: str
    scene: str
    description: str
    dimension: int
    bodies: int
    points: int
    steps: int
    frame_s: float
    engine: str
    engine_version: str
    profile: str
    certification: str
    method: str
    step_s: float
    options: str
    seed: int
    noise: bool
    mbds_xsim_version: str
    numpy_version: str
    drawn: int
    published: int
    rejected: int
    rejected_by: dict[str, int]
    """By the check that failed first."""
    counts: dict[str, dict[str, int]]
    """Trajectories of each part of the split in each interval."""
    figures: tuple[Range, ...]
    shards: int
    bytes: int
    """Of the file, its shards, and the rejected trajectories beside them."""


def summaries(path: Path) -> list[Summary]:
    """Sum up a data file, or all data sets of a folder.

    Raises:
        InputError: There are none, or their shards are missing.
    """
    return [summary_of(load_dataset(file)) for file in joined_files(path)]


def summary_of(data: Dataset) -> Summary:
    """Sum up a data set."""
    attrs, scene = data.attributes, data.scene
    rejected = rejected_beside(data)
    files = {data.path, *data.files, *rejected.glob("*.h5")}
    names = [file.name for file in data.files]
    by = causes(rejected, names)
    if attrs["kind"] == "rejected":
        by = Counter(map(cause_of, data.small["reason"]))
    own = {field.name for field in dataclasses.fields(Summary)} - {"scene"}
    return Summary(
        **{key: attrs[key] for key in own & ATTRIBUTES.keys()},
        file=str(data.path),
        scene=scene.name,
        description=scene.description,
        bodies=len(scene.bodies),
        points=len(data["graph/point_body"]),
        drawn=attrs["count"],
        rejected_by=dict(by.most_common()),
        counts=counts_of(data),
        figures=tuple(_ranges(data)),
        shards=len(data.files),
        bytes=sum(file.stat().st_size for file in files),
    )


def rejected_beside(data: Dataset) -> Path:
    """Where the trajectories lie that a joined file has not; as the layout has it."""
    folder = data.path.absolute().with_suffix("")
    if data.attributes["kind"] != "joined":
        return folder
    return rejected_folder(folder)


def counts_of(data: Dataset) -> dict[str, dict[str, int]]:
    """Count by split and interval; a shard has no split."""
    interval = data.index % len(INTERVALS)
    split = data.small.get("split")
    parts: dict[str, NDArray[Any]] = (
        {"all": np.ones(len(data), dtype=bool)}
        if split is None
        else {name: split == k for k, name in enumerate(SPLITS)}
    )
    return {
        part: {name: int((chosen & (interval == k)).sum()) for k, name in enumerate(INTERVALS)}
        for part, chosen in parts.items()
    }


def _ranges(data: Dataset) -> Iterable[Range]:
    figures, allowed = np.asarray(data["check/figure"]), np.asarray(data["check/allowed"])
    names, units = data["check/name"], data["check/unit"]
    for column, (name, unit) in enumerate(zip(names, units, strict=True)):
        here = ~np.isnan(figures[:, column])
        if not here.any():
            continue
        values, limits = figures[here, column], allowed[here, column]
        least = float(np.nanmin(limits)) if np.isfinite(limits).any() else None
        yield Range(
            check=str(name),
            unit=str(unit),
            trajectories=int(here.sum()),
            smallest=float(values.min()),
            median=float(np.median(values)),
            largest=float(values.max()),
            allowed=least,
        )
