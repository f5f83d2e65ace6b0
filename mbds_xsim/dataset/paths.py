"""A picture of a data set: the paths of its points in a trajectory of each interval."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.safe_text import in_figure
from mbds_xsim.base.write import write_whole
from mbds_xsim.dataset.points import Points
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.report import palette, themed
from mbds_xsim.report.skeleton import Projection
from mbds_xsim.report.themed import DRAWN, PALE
from mbds_xsim.scene.sampling_terms import INTERVALS

_WIDE = 1.8


def draw_paths(data: Dataset, path: Path) -> None:
    """Draw into a PNG file the first trajectory of each interval.

    Paths are seen as `mbds-xsim show --png` sees the scene, with the bodies at the start and at
    the end; a scene in one dimension as its coordinate over time.

    Raises:
        InputError: The set is empty, or the file cannot be written.
    """
    rows = [
        int(found[0])
        for k in range(len(INTERVALS))
        if len(found := np.flatnonzero(data.index % len(INTERVALS) == k))
    ]
    if not rows:
        msg = f"--png: {data.path} has no trajectories to draw"
        raise InputError(msg)
    size, stacked = _panel_size(data, rows)
    down, across = (len(rows), 1) if stacked else (1, len(rows))

    def draw(figure: Any) -> None:
        panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, row in zip(panels, rows, strict=True):
            _panel(axes, data, row)
        _name_axes(panels, data, stacked=stacked)
        about = data.attributes
        figure.suptitle(
            f"{in_figure(about['scene_name'])} in {about['engine']} {about['engine_version']}, "
            f"{about['method']} at {about['step_s']:.4g} s ({about['certification']})"
            + ("" if about["dimension"] == 1 else ": start grey, end black"),
            fontsize=10,
            y=1.0,
            va="bottom",
        )

    whole = (size[0] * across + 0.6, size[1] * down + 0.6)
    write_whole(path, themed.picture(draw, whole, "constrained", bbox_inches="tight"))


def _panel_size(data: Dataset, rows: list[int]) -> tuple[tuple[float, float], bool]:
    """Fit the panels to the motion [inches]; wide ones stand above each other."""
    if data.attributes["dimension"] == 1:
        return (3.6, 4.0), False
    view = _view(data)
    flat = np.concatenate(
        [view.flat(_lifted(data, np.asarray(data.position[row]))).reshape(-1, 2) for row in rows]
    )
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
    colour = palette.INTERVALS[interval]
    position = np.asarray(data.position[row], dtype=np.float64)
    if data.attributes["dimension"] == 1:
        axes.plot(data["time"], position[..., 0], color=colour, linewidth=1.0)
        return
    view = _view(data)
    flat = view.flat(_lifted(data, position))
    for point in range(flat.shape[1]):
        axes.plot(*flat[:, point].T, color=colour, linewidth=0.9, alpha=0.85)
    for frame, shade, width in ((0, PALE, 1.0), (-1, DRAWN, 1.2)):
        _bones(axes, data, view, flat[frame], shade, width)
    axes.set_aspect("equal", adjustable="box")


def _bones(
    axes: Any, data: Dataset, view: Projection, flat: Array, colour: str, width: float
) -> None:
    """Draw points and edges of one frame, and what is fixed."""
    fixed = view.flat(_lifted(data, np.asarray(data["graph/static_node"])))
    nodes = np.concatenate([flat, fixed])
    for a, b in np.asarray(data["graph/edge"]):
        axes.plot(*nodes[[a, b]].T, color=colour, linewidth=width)
    axes.plot(*flat.T, ".", color=colour, ms=3)
    axes.plot(*fixed.T, "^", color=DRAWN, ms=6)


def _lifted(data: Dataset, position: Array) -> Array:
    """Give points three components, 0 where the scene does not move, (…, point, 3)."""
    whole = np.zeros((*position.shape[:-1], 3))
    whole[..., Points.of(data.scene).axes] = position
    return whole


def _view(data: Dataset) -> Projection:
    """Look as the picture of the scene does."""
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
    """Name a coordinate, or say that it is none."""
    found = np.flatnonzero(np.abs(axis) > 1 - 1e-9)
    return f"{'xyz'[int(found[0])]} [m]" if len(found) else "projected [m]"
