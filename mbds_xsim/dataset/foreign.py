"""Trajectories from any source (npz, HDF5, CSV; documented names), checked against their scene.

They are read some at a time, so that a file may be larger than the memory.
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
from mbds_xsim.base.errors import InputError, located
from mbds_xsim.base.text import counted
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
from mbds_xsim.dataset.table import TIME, groups, read_csv, rounding_of
from mbds_xsim.scene.scene import Clock, Scene

_DAMAGE = (
    OSError, zipfile.BadZipFile, zlib.error, UnicodeDecodeError, EOFError, csv.Error, RuntimeError,
)  # fmt: skip
"""Errors raised on reading a file that is damaged, encrypted, or of another kind."""
_SAME_FRAME = 1e-4  # relative
_AT_ONCE = 100_000  # frames of bodies or points; the checks take some 5 kB for each
_RANKS = {name: len(FIELDS[name].axes) for name in (*MOTION, "index")}
"""Number of axes of each array of trajectories, if its first axis counts trajectories."""


SHORTEST_STEP = 1e-12
"""Shortest integration step that a file or a user may state [s]."""
_LONGEST_CONTACT = 1.0
"""Longest time of an impact that they may state [s]: a longer one is likely in milliseconds."""


@dataclass(frozen=True)
class Provenance:
    """Starts of trajectories and how they were made; None for anything unknown."""

    index: tuple[int, ...] | None = None
    seed: int | None = None
    noise: bool | None = None
    step_s: float | None = None
    method_order: int | None = None
    velocity_lag_s: float | None = None
    contact_time_s: float | None = None
    single_precision: bool | None = None

    def __post_init__(self) -> None:
        """Refuse times that are not finite, or too small."""
        for key in ("step_s", "velocity_lag_s", "contact_time_s"):
            if (value := getattr(self, key)) is not None:
                bounds.finite(key, value)
        if self.step_s is not None and self.step_s < SHORTEST_STEP:
            msg = f"step_s: got {self.step_s}, allowed is {SHORTEST_STEP:g} or more [s]"
            raise InputError(msg)
        if not 0.0 <= (self.contact_time_s or 0.0) <= _LONGEST_CONTACT:
            msg = f"contact_time_s: got {self.contact_time_s}, allowed is 0 to {_LONGEST_CONTACT:g}"
            raise InputError(f"{msg} [s]")


FACTS = tuple(each.name for each in fields(Provenance) if each.name != "index")
"""Facts that a file may state in addition to its arrays."""


@dataclass(frozen=True, eq=False)
class Foreign:
    """Some trajectories of a file, in the shapes of a data set."""

    source: str
    original: Scene
    """Scene as the user or the file gives it."""
    scene: Scene
    """Scene with the clock of the file."""
    arrays: dict[str, Array]
    """Arrays that the file has among `time`, `position`, `velocity`, `body/…` and `input/…`."""
    rounding: dict[str, float]
    """Largest rounding error of each array, in its own unit."""
    facts: dict[str, Any]
    """Fields of a `Provenance` that the file states."""
    first: int
    """Row in the file of the first of these trajectories."""
    total: int
    """Number of trajectories in the file."""

    @property
    def count(self) -> int:
        """Number of these trajectories."""
        return next(len(values) for name, values in self.arrays.items() if name != TIME)

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return len(self.arrays[TIME]) - 1


def completed(origin: Provenance, foreign: Foreign) -> Provenance:
    """Add the file's facts where the user gives none; keep only these trajectories' indices."""
    first, total = foreign.first, foreign.total
    facts = {key: value for key, value in vars(origin).items() if value is not None}
    if origin.index is not None:
        if len(origin.index) != total:
            raise InputError(
                f"--index: got {counted(len(origin.index), 'number')}, allowed for "
                f"{foreign.source} is one a trajectory, {total}"
            )
        facts["index"] = origin.index[first : first + foreign.count]
    elif len(index := foreign.facts.get("index", range(foreign.count))) != foreign.count:
        msg = f"{foreign.source}: index: got {counted(len(index), 'number')}"
        raise InputError(f"{msg}, allowed is one a trajectory")
    default = {} if origin.index is None else {"seed": 0}
    known, frame = Provenance(**(default | foreign.facts | facts)), foreign.scene.clock.frame
    if (known.step_s or 0.0) > frame * (1.0 + _SAME_FRAME):
        msg = f"{foreign.source}: step_s: got {known.step_s:g} s, allowed is up to {frame:g} s,"
        raise InputError(f"{msg} the time between frames; leave it out if steps are longer")
    return known


@dataclass(frozen=True)
class _OpenFile:
    """An open file, in a form common to all formats."""

    arrays: Mapping[str, Any]
    """Arrays with shape and type: successive slices read their rows, `[()]` reads everything."""
    facts: Mapping[str, Any]
    """Facts that the file states."""
    rounding: dict[str, float] = field(default_factory=dict)
    """Largest rounding errors of arrays whose type does not determine them."""


def read_foreign(path: Path, scene: Scene | None) -> Iterator[Foreign]:
    """Read a file of trajectories, some at a time.

    Args:
        path: `.csv`: one trajectory; `.npz`, `.h5` or `.hdf5`: one or more.
        scene: Scene that moves; the file's own if None.

    Raises:
        InputError: The file cannot be read, or does not hold trajectories of the scene.
    """
    refuse_other(path)
    if path.suffix not in _FORMATS:
        msg = f"{path}: got a file {path.suffix or 'without ending'}, allowed is .npz, .csv, .h5"
        raise InputError(msg)
    try:
        with _FORMATS[path.suffix](path, scene) as file:
            yield from _trajectories(file, scene, path)
    except _DAMAGE as error:
        msg = f"{path} cannot be read as {path.suffix[1:]} ({error}); damaged, or another format"
        raise InputError(msg) from error


@contextmanager
def _open_csv(path: Path, scene: Scene | None) -> Iterator[_OpenFile]:
    """Open the columns of one trajectory as arrays."""
    yield _OpenFile(*read_csv(path, scene))


@contextmanager
def _open_hdf5(path: Path, _: Scene | None) -> Iterator[_OpenFile]:
    """Open arrays by their paths, and attributes as facts."""
    with open_hdf5(path) as file:
        arrays = datasets_in(file)
        for name in _RANKS.keys() & arrays.keys():
            check_sources(arrays[name])
        facts = plain(file.attrs)
        if np.ndim(facts.get("index", 0)):
            arrays["index"] = facts.pop("index")
        yield _OpenFile(arrays, facts)


@contextmanager
def _open_npz(path: Path, _: Scene | None) -> Iterator[_OpenFile]:
    """Open arrays by their names; those without axes are facts."""
    with ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        refuse_bomb(path, sum(member.file_size for member in archive.infolist()))
        members = {
            name.removesuffix(".npy"): _member(stack.enter_context(archive.open(name)), path)
            for name in archive.namelist()
        }
        facts = {name: one[()].item() for name, one in members.items() if not one.shape}
        yield _OpenFile({name: one for name, one in members.items() if one.shape}, facts)


_FORMATS = {".csv": _open_csv, ".npz": _open_npz, ".h5": _open_hdf5, ".hdf5": _open_hdf5}


def _trajectories(file: _OpenFile, override: Scene | None, path: Path) -> Iterator[Foreign]:
    """Read some trajectories at a time; skip arrays that belong to no motion."""
    sources = _sources(file.arrays, path)
    many = {name for name, source in sources.items() if len(source.shape) == _RANKS.get(name)}
    if many == {"index"}:
        many = set()  # one trajectory: no array has an axis that counts them
    total = _same_count({name: sources[name].shape[0] for name in sorted(many)}, path)
    if total < 1:
        raise InputError(f"{path}: got no trajectory, allowed is 1 or more")
    each = max((math.prod(sources[name].shape[1:3]) for name in many), default=1)
    size = max(1, _AT_ONCE // max(1, each))
    shared = {name: np.asarray(source[()]) for name, source in sources.items() if name not in many}
    if override is None and "scene" not in file.facts:
        raise InputError(f"{path}: the file does not contain its scene; give it with --scene")
    scene = override or scene_of(file.facts["scene"], path, "give it with --scene")
    for first in range(0, total, size):
        arrays = shared | {name: np.asarray(sources[name][first : first + size]) for name in many}
        rounding = {name: rounding_of(array) for name, array in arrays.items()} | file.rounding
        with located(str(path)):
            own, checked = _checked(arrays, scene, rounding[TIME], first, str(path))
        facts = _facts_of(arrays, file.facts, f"{path}: ")
        yield Foreign(str(path), scene, own, checked, rounding, facts, first, total)


def _sources(arrays: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the arrays of motions; refuse unknown arrays, and values that are not numbers."""
    strange = [name for name in arrays if name not in FIELDS]
    if strange or TIME not in arrays:
        fault = f"an array {strange[0]!r}" if strange else "no array 'time'"
        raise InputError(f"{path}: got {fault}, allowed are {', '.join((TIME, *MOTION))}")
    sources = {name: one for name, one in arrays.items() if name in (TIME, *_RANKS)}
    for name, one in sources.items():
        if one.dtype.kind not in "fiu":
            msg = f"{path}: {name}: got values of the type {one.dtype}, allowed are numbers"
            raise InputError(msg)
    return sources


def _same_count(counts: dict[str, int], source: Path | str) -> int:
    """Return the number of trajectories common to all arrays; 1 if there are no arrays."""
    if len(set(counts.values())) > 1:
        sizes = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(f"{source}: got arrays of different numbers of trajectories: {sizes}")
    return max(counts.values(), default=1)


def _member(file: IO[bytes], path: Path) -> Any:
    """Open an array of an npz file; in Fortran order its rows are scattered, so all is read."""
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
    if dtype.hasobject or not dtype.itemsize:
        got = "Python objects" if dtype.hasobject else f"values of the type {dtype}"
        raise InputError(f"{path}: holds {got}; allowed are arrays of numbers")
    stream = _Stream(file, shape, dtype)
    return stream.take(shape[::-1]).transpose() if by_columns else stream


@dataclass(frozen=True)
class _Stream:
    """Array that can only be read from start to end."""

    file: IO[bytes]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def __getitem__(self, rows: slice | tuple[()]) -> NDArray[Any]:
        """Read the whole array, or the next rows."""
        if not isinstance(rows, slice):
            return self.take(self.shape)
        return self.take((len(range(*rows.indices(self.shape[0]))), *self.shape[1:]))

    def take(self, shape: tuple[int, ...]) -> NDArray[Any]:
        """Read an array of this shape from where the last one ended."""
        size = math.prod(shape) * self.dtype.itemsize
        content = self.file.read(size)
        if len(content) < size or min(shape, default=0) < 0:
            raise EOFError("an array ends too early")
        return np.frombuffer(content, self.dtype).reshape(shape)


def _facts_of(arrays: Mapping[str, Any], facts: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the file's facts on how it was made, and the indices of these trajectories."""
    provenance = {key: attribute(key, facts, where, strict=False) for key in FACTS if key in facts}
    if "index" in arrays:
        numbers = [{"index": each} for each in arrays["index"].ravel().tolist()]
        provenance["index"] = tuple(attribute("index", n, where, strict=False) for n in numbers)
    elif "index" in facts:  # of one trajectory
        provenance["index"] = (attribute("index", facts, where, strict=False),)
    return provenance


def _checked(
    arrays: Mapping[str, NDArray[Any]], scene: Scene, blur: float, first: int, source: str
) -> tuple[Scene, dict[str, Array]]:
    """Check times, shapes and numbers; return the scene with the file's clock, and the arrays."""
    if not {"position", "body/position"} & arrays.keys():
        msg = f"{source}: got no positions, allowed are position (of particles) or body/position"
        raise InputError(msg)
    for one, other in (("position", "orientation"), ("velocity", "angular_velocity")):
        if (f"body/{one}" in arrays) != (f"body/{other}" in arrays):
            msg = f"{source}: body/{one} and body/{other} belong together; one is missing"
            raise InputError(msg)
    if "body/velocity" in arrays and "body/position" not in arrays:
        msg = f"{source}: got body/velocity without body/position; give both, or leave it out"
        raise InputError(msg)
    clock = _clock(np.asarray(arrays[TIME], dtype=np.float64), blur, scene, source)
    time = clock.frame * np.arange(clock.steps + 1, dtype=np.float64)
    shaped = _shaped(arrays, scene, clock, first, source)
    return msgspec.structs.replace(scene, clock=clock), {TIME: time, **shaped}


def _clock(time: Array, blur: float, scene: Scene, source: str) -> Clock:
    """Return the clock of a file; its steps may differ as far as rounding of times (`blur`) allows.

    A missing frame is always found: rounding excuses no more than half a frame.
    """
    if time.ndim != 1 or len(time) < 2:
        msg = f"{source}: time: got shape {time.shape}, allowed is one number a frame, 2 or more"
        raise InputError(msg)
    if not np.isfinite(time).all():
        k = int(np.isfinite(time).argmin())
        raise InputError(f"{source}: time: got {time[k]} in frame {k}; allowed are finite numbers")
    steps = np.diff(time)
    median = float(np.median(steps))
    deviation = np.abs(steps - median)
    if median <= 0 or deviation.max() > _SAME_FRAME * median + min(4.0 * blur, 0.5 * median):
        k = int(deviation.argmax())
        raise InputError(
            f"{source}: time is not uniform: frame {k + 1} comes {steps[k]:.6g} s after the one "
            f"before, the median is {median:.6g} s; resample it, or leave frames out"
        )
    frame, mean = scene.clock.frame, float(steps.mean())
    tolerance = min(2.0 * blur / len(steps), 0.1 * frame)
    same = abs(mean - frame) <= _SAME_FRAME * frame + tolerance
    return Clock(frame=frame if same else mean, steps=len(steps))


def _shaped(
    arrays: Mapping[str, NDArray[Any]], scene: Scene, clock: Clock, first: int, source: str
) -> dict[str, Array]:
    """Return arrays with a first axis of trajectories; check shapes, and that all is finite."""
    shaped: dict[str, Array] = {}
    torque = arrays.get("input/torque", np.empty(0))
    if torque.size and all(group.name != "input/torque" for group in groups(scene)):
        msg = f"{source}: input/torque: got shape {torque.shape}, but {scene.name} has no hinges"
        raise InputError(f"{msg}; leave it out")
    for group in groups(scene):
        if group.name not in arrays:
            continue
        values = np.asarray(arrays[group.name], dtype=np.float64)
        per_step = FIELDS[group.name].per_step
        wanted = (clock.steps + (not per_step), *group.columns.shape)
        values = values[None] if values.ndim == len(wanted) else values
        if values.shape[1:] != wanted:
            shape = ", ".join(map(str, wanted))
            raise InputError(
                f"{source}: {group.name}: got shape {values.shape}, allowed for {scene.name} is "
                f"(trajectories, {shape}): {'steps' if per_step else 'frames'}, then {group.span}"
            )
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, frame = bad[0][:2]
            raise InputError(
                f"{source}: {group.name}: got {values[tuple(bad[0])]} in trajectory "
                f"{first + row}, frame {frame}; allowed are finite numbers: leave the "
                "trajectory out, or cut all off before"
            )
        shaped[group.name] = values
    _same_count({name: len(values) for name, values in shaped.items()}, source)
    return shaped
