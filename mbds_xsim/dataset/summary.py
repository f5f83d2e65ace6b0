"""Summary of a data set from its files, and a picture of the paths of its points."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.text import in_figure
from mbds_xsim.dataset.layout import ATTRIBUTES, SPLITS, rejected_folder
from mbds_xsim.dataset.points import Points
from mbds_xsim.dataset.read import Dataset, joined_files, load_dataset
from mbds_xsim.dataset.shard import cause_of, causes
from mbds_xsim.report import themed
from mbds_xsim.report.motion import Projection
from mbds_xsim.report.themed import DRAWN, PALE
from mbds_xsim.scene.sampling_terms import INTERVALS

_WIDE = 1.8  # width over height from which panels are stacked


@dataclass(frozen=True)
class Range:
    """Figures of a check over a data set."""

    check: str
    unit: str
    trajectories: int
    """Number of trajectories for which the check has a figure."""
    smallest: float
    median: float
    largest: float
    allowed: float | None
    """Smallest limit of any trajectory; None if the figure is shown but not judged."""
    kept: bool
    """Whether every trajectory keeps its own limit."""


@dataclass(frozen=True)
class Summary:
    """Summary of a data set."""

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
    """Numbers of rejected trajectories, keyed by the check that failed first."""
    counts: dict[str, dict[str, int]]
    """Number of trajectories in each part of the split and each interval."""
    figures: tuple[Range, ...]
    shards: int
    bytes: int
    """Size of the file, its shards, and the files of rejected trajectories."""


def summaries(path: Path) -> list[Summary]:
    """Summarize a data file, or all data sets of a folder.

    Raises:
        InputError: There are no data sets, or their shards are missing.
    """
    return [summary_of(load_dataset(file)) for file in joined_files(path)]


def summary_of(data: Dataset) -> Summary:
    """Summarize a data set."""
    attrs, scene = data.attributes, data.scene
    files = {data.path, *data.files, *_rejected_beside(data).glob("*.h5")}
    own = {field.name for field in dataclasses.fields(Summary)} - {"scene"}
    return Summary(
        **{key: attrs[key] for key in own & ATTRIBUTES.keys()},
        file=str(data.path),
        scene=scene.name,
        description=scene.description,
        bodies=len(scene.bodies),
        points=len(data["graph/point_body"]),
        drawn=attrs["count"],
        rejected_by=dict(causes_of(data).most_common()),
        counts=counts_of(data),
        figures=tuple(_ranges(data)),
        shards=len(data.files),
        bytes=sum(file.stat().st_size for file in files),
    )


def causes_of(data: Dataset) -> Counter[str]:
    """Count rejected trajectories, beside a data set or in it, by the check that failed first."""
    if data.is_rejected:
        return Counter(map(cause_of, data.small["reason"]))
    return causes(_rejected_beside(data), data.files)


def _rejected_beside(data: Dataset) -> Path:
    """Return the folder of a joined file's rejected trajectories; an absent one for other files."""
    folder = data.path.absolute().with_suffix("")
    return rejected_folder(folder) if data.attributes["kind"] == "joined" else folder


def counts_of(data: Dataset) -> dict[str, dict[str, int]]:
    """Count trajectories by split and interval; those of a shard, which has no split, as "all"."""
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
        applies = ~np.isnan(figures[:, column])
        if not applies.any():
            continue
        values, limits = figures[applies, column], allowed[applies, column]
        least = float(np.nanmin(limits)) if np.isfinite(limits).any() else None
        yield Range(
            check=str(name),
            unit=str(unit),
            trajectories=int(applies.sum()),
            smallest=float(values.min()),
            median=float(np.median(values)),
            largest=float(values.max()),
            allowed=least,
            kept=bool((values <= np.where(np.isnan(limits), np.inf, limits)).all()),
        )


def draw_paths(data: Dataset, path: Path) -> None:
    """Draw the first trajectory of each interval into a PNG file.

    The view is that of `mbds-xsim show --png`, with the bodies at the start and at the end. A scene
    in one dimension is drawn as its coordinate over time.

    Raises:
        InputError: The set is empty, or the file cannot be written.
    """
    rows = np.unique(data.index % len(INTERVALS), return_index=True)[1].tolist()
    if not rows:
        raise InputError(f"--png: {data.path} has no trajectories to draw")
    size, stacked = _panel_size(data, rows)
    down, across = (len(rows), 1) if stacked else (1, len(rows))

    def draw(figure: Any) -> None:
        panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, row in zip(panels, rows, strict=True):
            _panel(axes, data, row)
        _name_axes(panels, data, stacked=stacked)
        attrs = data.attributes
        figure.suptitle(
            f"{in_figure(attrs['scene_name'])} in {attrs['engine']} {attrs['engine_version']}, "
            f"{attrs['method']} at {attrs['step_s']:.4g} s ({data.standing})"
            + ("" if attrs["dimension"] == 1 else ": start grey, end black"),
            fontsize=10,
            y=1.0,
            va="bottom",
        )

    whole = (size[0] * across + 0.6, size[1] * down + 0.6)
    write_whole(path, themed.picture(draw, whole, "constrained", bbox_inches="tight"))


def _panel_size(data: Dataset, rows: list[int]) -> tuple[tuple[float, float], bool]:
    """Return the size of a panel [inches] that fits the motion, and whether panels are stacked."""
    if data.attributes["dimension"] == 1:
        return (3.6, 4.0), False
    flat = np.concatenate([_flat(data, data.position[row]).reshape(-1, 2) for row in rows])
    width, height = np.ptp(flat, axis=0) + 1e-9
    if width > _WIDE * height:
        return (9.0, max(1.2, 9.0 * float(height / width)) + 0.6), True
    return (min(4.8, max(2.4, 4.0 * float(width / height))) + 0.3, 4.0), False


def _panel(axes: Any, data: Dataset, row: int) -> None:
    """Draw one trajectory."""
    index = int(data.index[row])
    interval = index % len(INTERVALS)
    axes.set_title(f"trajectory {index}, {INTERVALS[interval]}", fontsize=9)
    axes.grid(color="#e6eaed", linewidth=0.6)
    axes.set_axisbelow(True)
    colour = themed.INTERVALS[interval]
    position = np.asarray(data.position[row], dtype=np.float64)
    if data.attributes["dimension"] == 1:
        axes.plot(data["time"], position[..., 0], color=colour, linewidth=1.0)
        return
    flat = _flat(data, position)
    for point in range(flat.shape[1]):
        axes.plot(*flat[:, point].T, color=colour, linewidth=0.9, alpha=0.85)
    for frame, shade, width in ((0, PALE, 1.0), (-1, DRAWN, 1.2)):
        _bones(axes, data, flat[frame], shade, width)
    axes.set_aspect("equal", adjustable="box")


def _bones(axes: Any, data: Dataset, flat: Array, colour: str, width: float) -> None:
    """Draw the points, edges and fixed nodes of one frame."""
    graph = Points.of(data.scene).graph()  # not the file's, which may name points that are not here
    fixed = _flat(data, graph["graph/static_node"])
    nodes = np.concatenate([flat, fixed])
    for a, b in graph["graph/edge"]:
        axes.plot(*nodes[[a, b]].T, color=colour, linewidth=width)
    axes.plot(*flat.T, ".", color=colour, ms=3)
    axes.plot(*fixed.T, "^", color=DRAWN, ms=6)


def _flat(data: Dataset, values: NDArray[Any]) -> Array:
    """Project positions, given by the components in which the scene moves."""
    return _view(data).flat(Points.of(data.scene).lifted(values))


def _view(data: Dataset) -> Projection:
    """Return the projection that the picture of the scene has."""
    points = Points.of(data.scene)
    rest = points.mechanism.com[points.body] + points.offset
    return Projection.of(rest, data.scene.dimension)


def _name_axes(panels: Any, data: Dataset, *, stacked: bool) -> None:
    across, up = "time [s]", "x [m]"
    if data.attributes["dimension"] > 1:
        across, up = (_direction(axis) for axis in _view(data).axes[:2])
    for axes in panels[-1:] if stacked else panels:
        axes.set_xlabel(across)
    for axes in panels if stacked else panels[:1]:
        axes.set_ylabel(up)


def _direction(axis: Array) -> str:
    """Return the name of an axis, "projected" if it is not a coordinate."""
    components = np.flatnonzero(np.abs(axis) > 1 - 1e-9)
    return f"{'xyz'[int(components[0])]} [m]" if len(components) else "projected [m]"
