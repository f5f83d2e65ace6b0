"""The layout of data files, as data; `docs/dataset-layout.md` shows it as a tree.

Every file is HDF5 in the format of version 1.10. Datasets are contiguous and without filters: a
trajectory, or any window of its frames, is a single run of bytes that can be mapped into memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import on_a_line

SUFFIX = ".h5"
JOINT = f"joint{SUFFIX}"
"""Name of the file that says which trajectories are valid in all variants of a scene."""


def rejected_folder(folder: Path) -> Path:
    """Return the folder of a variant's rejected trajectories, given the folder of its shards."""
    return folder.parents[1] / "rejected" / folder.parent.name / folder.name


FORMAT = "mbds-xsim data"
VERSION = 1
"""Version of the layout. Readers refuse a newer one; a new optional dataset does not raise it."""


@dataclass(frozen=True)
class Field:
    """A dataset of a file."""

    name: str
    """Path in the file."""
    axes: tuple[str, ...]
    dtype: str
    """Type as numpy writes it; "text" for UTF-8 of fixed length."""
    unit: str
    meaning: str
    kinds: tuple[str, ...] = ("shard", "rejected", "joined")
    """Kinds of files that have the dataset."""

    @property
    def per_trajectory(self) -> bool:
        """Whether the first axis counts trajectories, so that shards are joined along it."""
        return self.axes[0] == "trajectory"

    @property
    def per_step(self) -> bool:
        """Whether the values are for the steps between frames, which are one fewer than frames."""
        return "step" in self.axes


_ROW = ("trajectory",)
_FRAMES, _STEPS = (*_ROW, "frame"), (*_ROW, "step")

_FIELDS = (
    Field("index", _ROW, "<i8", "1", "number of the trajectory, the same in all engines"),
    Field("interval", _ROW, "<u1", "1", "0 low, 1 medium, 2 high: index mod 3"),
    Field("time", ("frame",), "<f8", "s", "of each frame"),
    Field("position", (*_FRAMES, "point", "axis"), "<f4", "m", "of the particles in W"),
    Field("velocity", (*_FRAMES, "point", "axis"), "<f4", "m/s", "of the particles in W"),
    Field("body/position", (*_FRAMES, "body", "xyz"), "<f8", "m", "of centres of mass in W"),
    Field("body/orientation", (*_FRAMES, "body", "wxyz"), "<f8", "1", "unit quaternion, body to W"),
    Field("body/velocity", (*_FRAMES, "body", "xyz"), "<f8", "m/s", "of centres of mass in W"),
    Field("body/angular_velocity", (*_FRAMES, "body", "xyz"), "<f8", "rad/s", "in W"),
    Field("start/position", (*_ROW, "body", "xyz"), "<f8", "m", "as drawn"),
    Field("start/orientation", (*_ROW, "body", "wxyz"), "<f8", "1", "as drawn"),
    Field("start/velocity", (*_ROW, "body", "xyz"), "<f8", "m/s", "as drawn"),
    Field("start/angular_velocity", (*_ROW, "body", "xyz"), "<f8", "rad/s", "as drawn"),
    Field("input/force", (*_STEPS, "body", "xyz"), "<f8", "N",
          "all that acts on centres of mass in W, the noise included, held over each step"),
    Field("input/known_force", (*_STEPS, "body", "xyz"), "<f8", "N",
          "the same without the noise: what a model may be told; absent where there is none"),
    Field("input/torque", (*_STEPS, "hinge"), "<f8", "N·m",
          "about each hinge, on the child, and the opposite on the parent, held over each step"),
    Field("check/name", ("check",), "text", "", "of each check; docs/checks.md defines them"),
    Field("check/unit", ("check",), "text", "", "of its figure and of what is allowed"),
    Field("check/figure", (*_ROW, "check"), "<f8", "check/unit",
          "worst over the frames; not a number where the check does not apply"),
    Field("check/allowed", (*_ROW, "check"), "<f8", "check/unit",
          "what the figure may reach; infinite where it is shown, not judged"),
    Field("check/frame", (*_ROW, "check"), "<i4", "1", "of the worst value; −1: none"),
    Field("graph/edge", ("edge", "two"), "<i4", "1", "pairs of nodes: points, then static nodes"),
    Field("graph/point_body", ("point",), "<i4", "1", "body of each point"),
    Field("graph/static_node", ("static", "axis"), "<f8", "m", "fixed points in W"),
    Field("graph/body_name", ("body",), "text", "", "of each body"),
    Field("reason", _ROW, "text", "", "why it was rejected", ("rejected",)),
    Field("split", _ROW, "<u1", "1", "0 train, 1 validation, 2 test", ("joined",)),
    Field("shard/file", ("shard",), "text", "", "where its trajectories are", ("joined",)),
    Field("shard/rows", ("shard",), "<i8", "1", "how many it has", ("joined",)),
    Field("shard/content", ("shard",), "text", "", "its content_sha256", ("joined",)),
    Field("variant", ("variant",), "text", "", "engine and settings", ("joint",)),
    Field("valid", ("variant", "number"), "|b1", "1",
          "whether the trajectory of this number is published", ("joint",)),
    Field("valid_in_all", ("number",), "|b1", "1",
          "the same in all variants, without those in which nothing is published", ("joint",)),
)  # fmt: skip
FIELDS = {field.name: field for field in _FIELDS}
"""Datasets by name, in the order of the layout."""

MOTION = tuple(
    field.name
    for field in _FIELDS
    if field.axes[1:2] in (("frame",), ("step",)) and field.name != "input/known_force"
)
"""Datasets that hold motions and the inputs that drive them."""

Kind = Literal["text", "truth", "natural", "number", "positive"]
"""Kind of values that an attribute has."""

_LARGEST = float(np.finfo(np.float64).max)
_KINDS: dict[Kind, tuple[str, Any]] = {
    "text": ("text", str),
    "truth": ("true or false", bool),
    "natural": ("a whole number from 0", Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]),
    "number": ("a finite number", Annotated[float, msgspec.Meta(ge=-_LARGEST, le=_LARGEST)]),
    "positive": ("a positive number", Annotated[float, msgspec.Meta(gt=0, le=_LARGEST)]),
}
"""Allowed values of each kind, in words and as a type."""

ATTRIBUTES: dict[str, Kind] = {
    "kind": "text",
    "scene_name": "text",
    "scene": "text",
    "dimension": "natural",
    "frame_s": "positive",
    "steps": "natural",
    "seed": "natural",
    "noise": "truth",
    "engine": "text",
    "engine_version": "text",
    "adapter_revision": "natural",
    "method": "text",
    "method_family": "text",
    "method_order": "natural",
    "profile": "text",
    "certification": "text",
    "step_s": "positive",
    "options": "text",
    "velocity_lag_s": "number",
    "single_precision": "truth",
    "contact_time_s": "number",
    "audit_sample": "text",
    "checks_version": "natural",
    "first": "natural",
    "count": "natural",
    "published": "natural",
    "rejected": "natural",
    "numpy_version": "text",
    "mbds_xsim_version": "text",
}
"""Attributes of a file in addition to its format, layout version and checksum."""

ATTRIBUTE_DEFAULTS: dict[str, Any] = {
    "adapter_revision": 0,
    "checks_version": 0,
    "single_precision": False,
}
"""Defaults of attributes that a file may lack: older ones have no revision and no version."""


def attribute(
    key: str, attributes: Mapping[str, Any], where: str, advice: str = "", *, strict: bool = True
) -> Any:
    """Return an attribute, or the number "index" of a trajectory, in its type.

    Args:
        key: Name of the attribute.
        attributes: Attributes of the file.
        where: Beginning of the error line.
        advice: End of the error line.
        strict: Whether the value must have its type; if not, text and other numbers are converted.

    Raises:
        InputError: The attribute is missing, or its value is not allowed.
    """
    words, kind = _KINDS[ATTRIBUTES.get(key, "natural")]
    try:
        return msgspec.convert(attributes.get(key), kind, strict=strict)
    except msgspec.ValidationError:
        got = on_a_line(repr(attributes[key]))[:60] if key in attributes else "none"
        raise InputError(f"{where}{key}: got {got}, allowed is {words}{advice}") from None


SHARED = ("format", "layout_version", "scene_name", "scene", "seed", "noise")
"""Attributes that are the same in all variants of a scene in one folder."""

ONE_SIZE = "load_pairs, train and shift take sets of one size only"
"""Why a set is told whose number of trajectories is not that of the others in its folder."""
INTEGRITY = ("finite", "start")
"""Checks that even an uncertified trajectory must pass."""

AUDIT_EVERY = 15_000
AUDITED = 3  # one of each interval
AUDIT_SAMPLE = f"index mod {AUDIT_EVERY} < {AUDITED}"
"""Trajectories that are also compared with the reference, which would cost too much for all."""


def sampled(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows of the trajectories in the audit sample."""
    return np.flatnonzero(index % AUDIT_EVERY < AUDITED)


SPLITS = ("train", "validation", "test")
"""Parts of a data set by index, the same in every engine."""
_OF = 15_000
_ENDS = (12_000, 13_500)  # the paper has 13 500 and 1 500; the last 1 500 of the 13 500 validate


def split_of(index: NDArray[np.int64], trajectories: int) -> NDArray[np.uint8]:
    """Return 0 for train (the first 80 % drawn), 1 for validation (the next 10 %), 2 for test."""
    ends = [end * trajectories // _OF for end in _ENDS]
    return np.searchsorted(ends, index, side="right").astype(np.uint8)
