"""What a data file says of itself and holds, compared with the layout and with its scene."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.hdf5 import open_hdf5, plain
from mbds_xsim.dataset.layout import ATTRIBUTES, FIELDS, FORMAT, SHARED, VERSION, Field, Kind
from mbds_xsim.dataset.points import Points
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene

_JOINT = (*SHARED, "kind", "count")
_ALLOWED: dict[Kind, tuple[str, Callable[[Any], bool]]] = {
    "text": ("text", lambda got: isinstance(got, str)),
    "truth": ("true or false", lambda got: isinstance(got, bool)),
    "natural": (
        "a whole number from 0",
        lambda got: isinstance(got, int) and not isinstance(got, bool) and got >= 0,
    ),
    "number": (
        "a finite number",
        lambda got: isinstance(got, int | float) and math.isfinite(got),
    ),
    "positive": (
        "a positive number",
        lambda got: isinstance(got, int | float) and math.isfinite(got) and got > 0,
    ),
}


def attributes_of(path: Path) -> dict[str, Any]:
    """Attributes of a data file.

    Raises:
        InputError: It is no data file, of a newer layout, or an attribute is missing or wrong.
    """
    with open_hdf5(path) as file:
        found = plain(file.attrs)
    if not _is(found.get("format"), FORMAT):
        msg = f"{path} is HDF5, but no {FORMAT} file: its attribute 'format' does not say so"
        raise InputError(msg)
    if not isinstance(found.get("layout_version"), int) or found["layout_version"] > VERSION:
        msg = (
            f"{path} has layout version {found.get('layout_version')}, this program reads up to "
            f"{VERSION}; install a newer mbds-xsim"
        )
        raise InputError(msg)
    wanted = [key for key in ATTRIBUTES if key in _JOINT or not _is(found.get("kind"), "joint")]
    for key in wanted:
        words, fits = _ALLOWED[ATTRIBUTES[key]]
        if not fits(found.get(key)):
            got = repr(found[key])[:60] if key in found else "none"
            msg = f"{path}: attribute {key}: got {got}, allowed is {words}; get the file again"
            raise InputError(msg)
    return found


def scene_of(text: Any, path: Path, advice: str = "get the file again") -> Scene:
    """Read the scene that a file has as text.

    Raises:
        InputError: It is none.
    """
    try:
        return msgspec.convert(tomllib.loads(text), Scene)
    # The last are what the parser has for text that is none, numbers and brackets without end.
    except (msgspec.ValidationError, TypeError, ValueError, RecursionError) as error:
        msg = f"{path}: its attribute scene is no scene: {error}; {advice}"
        raise InputError(msg) from error


def _is(got: Any, wanted: str) -> bool:
    return isinstance(got, str) and got == wanted


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
    for field in FIELDS.values():
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
