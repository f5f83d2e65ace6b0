"""Trajectories from anywhere: npz, HDF5 or CSV in documented names, held against their scene.

They are read some at a time, so that any file fits the memory.
"""

from __future__ import annotations

import csv
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mbds_xsim.base import bounds
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.export import TIME, groups, read_csv, rounding_of
from mbds_xsim.dataset.hdf5 import (
    check_sources,
    datasets_in,
    open_hdf5,
    plain,
    refuse_bomb,
    refuse_other,
    scene_of,
)
from mbds_xsim.dataset.layout import FIELDS, MOTION, attribute
from mbds_xsim.scene.scene import Clock, Scene

_DAMAGE = (
    OSError, zipfile.BadZipFile, zlib.error, UnicodeDecodeError, EOFError, csv.Error, RuntimeError,
)  # fmt: skip
"""What reading a file raises that is damaged, encrypted, or something else."""
_SAME_FRAME = 1e-4  # relative
_AT_ONCE = 100_000  # frames of bodies or points; the checks take some 5 kB for each
_RANKS = {name: len(FIELDS[name].axes) for name in (*MOTION, "index")}
"""Arrays of trajectories, and how many axes they have where the first one counts trajectories."""


@dataclass(frozen=True)
class Provenance:
    """Which starts trajectories have and how they were made, as far as it is known."""

    index: tuple[int, ...] | None = None
    seed: int | None = None
    noise: bool | None = None
    step_s: float | None = None
    method_order: int | None = None
    velocity_lag_s: float | None = None
    contact_time_s: float | None = None
    single_precision: bool | None = None

    def __post_init__(self) -> None:
        """Refuse times that are no numbers."""
        for key in ("step_s", "velocity_lag_s", "contact_time_s"):
            if (value := getattr(self, key)) is not None:
                bounds.finite(key, value)


FACTS = tuple(each.name for each in fields(Provenance) if each.name != "index")
"""What a file may say beside its numbers."""


@dataclass(frozen=True, eq=False)
class Foreign:
    """Some trajectories of a file, in the shapes of a data set."""

    source: str
    asked: Scene
    """As it was given."""
    scene: Scene
    """With the clock of the file."""
    arrays: dict[str, Array]
    """Those of `time`, `position`, `velocity`, `body/…`, `input/…` that are there."""
    rounding: dict[str, float]
    """By how much the numbers of each array may be rounded, in their own unit."""
    said: dict[str, Any]
    """Those fields of a `Provenance` that the file tells."""
    first: int
    """Place in the file of the first of these trajectories."""
    total: int
    """Trajectories of the file."""

    @property
    def count(self) -> int:
        """How many trajectories these are."""
        return next(len(values) for name, values in self.arrays.items() if name != TIME)

    @property
    def steps(self) -> int:
        """Recorded steps."""
        return len(self.arrays[TIME]) - 1


@dataclass(frozen=True)
class _Opened:
    """A file that is read: every format gives the same."""

    arrays: Mapping[str, Any]
    """They give their shape and type, rows by slices without a gap, and all of them by `[()]`."""
    facts: Mapping[str, Any]
    """What else the file says."""
    rounding: dict[str, float] = field(default_factory=dict)
    """Of arrays whose type does not tell by how much their numbers may be rounded."""


def read_foreign(path: Path, scene: Scene | None) -> Iterator[Foreign]:
    """Read a file of trajectories, some at a time.

    Args:
        path: `.csv`: one trajectory; `.npz`, `.h5` or `.hdf5`: one or more.
        scene: What moves; None: what the file itself says.

    Raises:
        InputError: It cannot be read, or is no trajectory of the scene.
    """
    refuse_other(path)
    if path.suffix not in _FORMATS:
        msg = f"{path}: got a file {path.suffix or 'without ending'}, allowed is .npz, .csv, .h5"
        raise InputError(msg)
    try:
        with _FORMATS[path.suffix](path, scene) as opened:
            yield from _trajectories(opened, scene, path)
    except _DAMAGE as error:
        msg = f"{path} cannot be read as {path.suffix[1:]} ({error}); it is something else"
        raise InputError(msg) from error


@contextmanager
def _open_csv(path: Path, scene: Scene | None) -> Iterator[_Opened]:
    """Give the columns of one trajectory as arrays."""
    yield _Opened(*read_csv(path, scene))


@contextmanager
def _open_hdf5(path: Path, _: Scene | None) -> Iterator[_Opened]:
    """Give arrays by their paths and attributes as facts."""
    with open_hdf5(path) as file:
        arrays = datasets_in(file)
        for name in _RANKS.keys() & arrays.keys():
            check_sources(arrays[name])
        yield _Opened(arrays, plain(file.attrs))


@contextmanager
def _open_npz(path: Path, _: Scene | None) -> Iterator[_Opened]:
    """Give arrays by their names; what has no axes is a fact."""
    with ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        refuse_bomb(path, sum(member.file_size for member in archive.infolist()))
        members = {
            name.removesuffix(".npy"): _member(stack.enter_context(archive.open(name)), path)
            for name in archive.namelist()
        }
        facts = {name: one[()].item() for name, one in members.items() if not one.shape}
        yield _Opened({name: one for name, one in members.items() if one.shape}, facts)


_FORMATS = {".csv": _open_csv, ".npz": _open_npz, ".h5": _open_hdf5, ".hdf5": _open_hdf5}


def _trajectories(opened: _Opened, given: Scene | None, path: Path) -> Iterator[Foreign]:
    """Read some trajectories at a time; what belongs to no motion is passed over."""
    sources = _sources(opened.arrays, path)
    many = {name for name, one in sources.items() if len(one.shape) == _RANKS.get(name)}
    if many == {"index"}:
        many = set()  # one trajectory, whose arrays have no such axis
    total = _same_count({name: sources[name].shape[0] for name in sorted(many)}, path)
    if total < 1:
        msg = f"{path}: got no trajectory, allowed is 1 or more"
        raise InputError(msg)
    each = max((math.prod(sources[name].shape[1:3]) for name in many), default=1)
    size = max(1, _AT_ONCE // max(1, each))
    shared = {name: np.asarray(one[()]) for name, one in sources.items() if name not in many}
    scene = given or _own_scene(opened.facts, path)
    for first in range(0, total, size):
        arrays = shared | {name: np.asarray(sources[name][first : first + size]) for name in many}
        rounding = {name: rounding_of(array) for name, array in arrays.items()} | opened.rounding
        own, checked = _checked(arrays, scene, rounding[TIME], first, str(path))
        said = _said(arrays, opened.facts, f"{path}: ")
        yield Foreign(str(path), scene, own, checked, rounding, said, first, total)


def _sources(arrays: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Give what belongs to motions, or refuse a file with other arrays or values."""
    strange = [name for name in arrays if name not in FIELDS]
    if strange or TIME not in arrays:
        got = f"an array {strange[0]!r}" if strange else "no array 'time'"
        msg = f"{path}: got {got}, allowed are {', '.join((TIME, *MOTION))}"
        raise InputError(msg)
    sources = {name: one for name, one in arrays.items() if name in (TIME, *_RANKS)}
    for name, one in sources.items():
        if one.dtype.kind not in "fiu":
            msg = f"{path}: {name}: got values of the type {one.dtype}, allowed are numbers"
            raise InputError(msg)
    return sources


def _same_count(counts: dict[str, int], source: Path | str) -> int:
    """Give how many trajectories arrays have, 1 where none is of several."""
    if len(set(counts.values())) > 1:
        sizes = ", ".join(f"{name} {count}" for name, count in counts.items())
        msg = f"{source}: got arrays of different numbers of trajectories: {sizes}"
        raise InputError(msg)
    return max(counts.values(), default=1)


def _member(file: IO[bytes], path: Path) -> Any:
    """Give an array of an npz file; one in Fortran's order is read whole, rows are all over it."""
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    try:
        version = npy.read_magic(file)
        shape, by_columns, dtype = readers[version](file)
    except KeyError:
        msg = f"{path}: holds an array in version {version} of npy, allowed are 1.0 and 2.0"
        raise InputError(msg) from None
    except (ValueError, TokenError) as error:  # the latter for a header that is cut off
        msg = f"{path}: holds {file.name}, which is no array; allowed are arrays of numbers"
        raise InputError(msg) from error
    if dtype.hasobject:
        msg = f"{path}: holds Python objects; allowed are arrays of numbers"
        raise InputError(msg)
    stream = _Stream(file, shape, dtype)
    return stream.take(shape[::-1]).transpose() if by_columns else stream


@dataclass(frozen=True)
class _Stream:
    """An array that can be read from its beginning on alone."""

    file: IO[bytes]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def __getitem__(self, rows: slice | tuple[()]) -> NDArray[Any]:
        """Read all of it, or the next rows."""
        if not isinstance(rows, slice):
            return self.take(self.shape)
        return self.take((len(range(*rows.indices(self.shape[0]))), *self.shape[1:]))

    def take(self, shape: tuple[int, ...]) -> NDArray[Any]:
        """Read an array of this shape from where the last one ended."""
        wanted = math.prod(shape) * self.dtype.itemsize
        content = self.file.read(wanted)
        if len(content) < wanted or min(shape, default=0) < 0:
            msg = "an array ends too early"
            raise EOFError(msg)
        return np.frombuffer(content, self.dtype).reshape(shape)


def _own_scene(facts: Mapping[str, Any], path: Path) -> Scene:
    if "scene" not in facts:
        msg = f"{path}: the file does not tell its scene; give it with --scene"
        raise InputError(msg)
    return scene_of(facts["scene"], path, "give it with --scene")


def _said(arrays: Mapping[str, Any], facts: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Give what the file tells of how it was made, and the numbers of these trajectories."""
    said = {key: attribute(key, facts, where, strict=False) for key in FACTS if key in facts}
    if "index" in arrays:
        numbers = [{"index": each} for each in arrays["index"].ravel().tolist()]
        said["index"] = tuple(attribute("index", n, where, strict=False) for n in numbers)
    return said


def _checked(
    arrays: Mapping[str, NDArray[Any]], scene: Scene, blur: float, first: int, source: str
) -> tuple[Scene, dict[str, Array]]:
    """Hold times, shapes and numbers against the scene; give it with their clock, and them."""
    if not {"position", "body/position"} & arrays.keys():
        msg = f"{source}: got no positions, allowed are position (of particles) or body/position"
        raise InputError(msg)
    for one, other in (("position", "orientation"), ("velocity", "angular_velocity")):
        if (f"body/{one}" in arrays) != (f"body/{other}" in arrays):
            msg = f"{source}: body/{one} and body/{other} belong together; one is missing"
            raise InputError(msg)
    clock = _clock(np.asarray(arrays[TIME], dtype=np.float64), blur, scene, source)
    time = clock.frame * np.arange(clock.steps + 1, dtype=np.float64)
    shaped = _shaped(arrays, scene, clock, first, source)
    return msgspec.structs.replace(scene, clock=clock), {TIME: time, **shaped}


def _clock(time: Array, blur: float, scene: Scene, source: str) -> Clock:
    """Give the frames of a file; as far as times may be rounded, by `blur`, they need not be alike.

    Rounding hides no frame that is missing: it never excuses half a frame.
    """
    if time.ndim != 1 or len(time) < 2:
        msg = f"{source}: time: got shape {time.shape}, allowed is one number a frame, 2 or more"
        raise InputError(msg)
    if not np.isfinite(time).all():
        k = int(np.isfinite(time).argmin())
        msg = f"{source}: time: got {time[k]} in frame {k}; allowed are finite numbers"
        raise InputError(msg)
    steps = np.diff(time)
    usual = float(np.median(steps))
    off = np.abs(steps - usual)
    if usual <= 0 or off.max() > _SAME_FRAME * usual + min(4.0 * blur, 0.5 * usual):
        k = int(off.argmax())
        msg = (
            f"{source}: time is not uniform: frame {k + 1} comes {steps[k]:.6g} s after the one "
            f"before, the median is {usual:.6g} s; resample it, or leave frames out"
        )
        raise InputError(msg)
    frame, mean = scene.clock.frame, float(steps.mean())
    coarse = min(2.0 * blur / len(steps), 0.1 * frame)
    same = abs(mean - frame) <= _SAME_FRAME * frame + coarse
    return Clock(frame=frame if same else mean, steps=len(steps))


def _shaped(
    arrays: Mapping[str, NDArray[Any]], scene: Scene, clock: Clock, first: int, source: str
) -> dict[str, Array]:
    """Give the arrays a first axis of trajectories and hold their shapes against the scene."""
    shaped: dict[str, Array] = {}
    for group in groups(scene):
        if group.name not in arrays:
            continue
        values = np.asarray(arrays[group.name], dtype=np.float64)
        per_step = FIELDS[group.name].per_step
        wanted = (clock.steps + (not per_step), *group.columns.shape)
        values = values[None] if values.ndim == len(wanted) else values
        if values.shape[1:] != wanted:
            shape = ", ".join(map(str, wanted))
            msg = (
                f"{source}: {group.name}: got shape {values.shape}, allowed for {scene.name} is "
                f"(trajectories, {shape}): {'steps' if per_step else 'frames'}, then {group.span}"
            )
            raise InputError(msg)
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, frame = bad[0][:2]
            msg = (
                f"{source}: {group.name}: got {values[tuple(bad[0])]} in trajectory "
                f"{first + row}, frame {frame}; allowed are finite numbers: cut the "
                "trajectory off before"
            )
            raise InputError(msg)
        shaped[group.name] = values
    _same_count({name: len(values) for name, values in shaped.items()}, source)
    return shaped
