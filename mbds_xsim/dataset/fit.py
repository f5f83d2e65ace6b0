"""Hold the datasets of a file against the layout and the scene: which there are, type and shape."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mbds_xsim.dataset.layout import FIELDS, Field
from mbds_xsim.dataset.points import Points
from mbds_xsim.errors import InputError
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.scene import Scene

__all__ = ["check_fit", "misfits"]

_OPTIONAL = ("input/known_force",)


def check_fit(file: Any, path: Path, kind: str, scene: Scene | None) -> None:
    """Raise InputError where the datasets are not those of the layout and the scene."""
    wrong = next(misfits(file, kind, scene), None)
    if wrong is not None:
        msg = f"{path}: {wrong}; get it again, or generate it anew"
        raise InputError(msg)


def misfits(file: Any, kind: str, scene: Scene | None) -> Iterator[str]:
    """Say of each dataset that is not as the layout has it what is wrong with it.

    Args:
        file: An open data file.
        kind: Of the file.
        scene: Decides the lengths of axes; None where the file has no trajectories.
    """
    sizes = {"two": 2} if scene is None else _sizes(scene)
    for field in FIELDS:
        if kind not in field.kinds:
            continue
        dataset = file.get(field.name)
        if isinstance(dataset, h5py.Dataset) and dataset.shape is not None:
            yield from _misfit(field, dataset, sizes)
        elif dataset is not None or field.name not in _OPTIONAL:
            yield f"layout: dataset {field.name} is missing"


def _misfit(field: Field, dataset: Any, sizes: dict[str, int]) -> Iterator[str]:
    """Compare one; an axis that nothing has decided yet is as long as its first dataset's."""
    for axis, size in zip(field.axes, dataset.shape, strict=False):
        sizes.setdefault(axis, size)
    wanted = tuple(sizes.get(axis, 0) for axis in field.axes)
    if dataset.shape != wanted:
        yield f"layout: {field.name} has the shape {dataset.shape}, not {wanted}"
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    if is_text != (field.dtype == "text") or not (
        is_text or dataset.dtype == np.dtype(field.dtype)
    ):
        yield f"layout: {field.name} has the type {dataset.dtype}, not {field.dtype}"


def _sizes(scene: Scene) -> dict[str, int]:
    """Lengths of the axes that the scene decides."""
    points = Points.of(scene)
    return {
        "frame": scene.clock.steps + 1,
        "step": scene.clock.steps,
        "body": len(scene.bodies),
        "point": len(points.body),
        "axis": len(points.axes),
        "hinge": len(Mechanism.of(scene).hinges),
        "edge": len(scene.edges),
        "static": len(scene.anchors),
        "xyz": 3,
        "wxyz": 4,
        "two": 2,
    }
