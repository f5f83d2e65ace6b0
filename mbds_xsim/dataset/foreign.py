"""Trajectories from anywhere: npz, HDF5 or CSV in documented names, held against their scene.

They are read some at a time, so that any file fits the memory.
"""

from __future__ import annotations

import csv
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.columns import PER_STEP, TIME, groups, read_csv, rounding_of
from mbds_xsim.dataset.hdf5 import (
    check_sources,
    datasets_in,
    open_hdf5,
    plain,
    refuse_bomb,
    refuse_other,
)
from mbds_xsim.dataset.layout import FIELDS
from mbds_xsim.dataset.proof import scene_of
from mbds_xsim.scene.scene import Clock, Scene

Array = NDArray[np.float64]

_NATURAL = "a whole number from 0"
_NUMBER = "a finite number"

FACTS = {
    "seed": _NATURAL,
    "noise": "true or false",
    "step_s": _NUMBER,
    "method_order": _NATURAL,
    "velocity_lag_s": _NUMBER,
    "contact_time_s": _NUMBER,
}
"""What a file may say beside its numbers: of its start, and of how it was made."""

_DAMAGE = (
    OSError, zipfile.BadZipFile, zlib.error, UnicodeDecodeError, EOFError, csv.Error,
    NotImplementedError, RuntimeError,
)  # fmt: skip
"""What reading a file raises that is damaged, encrypted, or something else."""
_SAME_FRAME = 1e-4  # relative; what rounding to float32 makes of frames
_AT_ONCE = 100_000  # frames of bodies or points; the checks take some 5 kB for each
_RANKS = {
    "position": 4,
    "velocity": 4,
    "body/position": 4,
    "body/orientation": 4,
    "body/velocity": 4,
    "body/angular_velocity": 4,
    "input/force": 4,
    "input/torque": 3,
    "index": 1,
}
"""Arrays of trajectories, and how many axes they have where the first one counts trajectories."""


@dataclass(frozen=True, eq=False)
class Foreign:
    """What a file holds, in the shapes of a data set."""

    source: str
    asked: Scene
    """As it was given."""
    scene: Scene
    """With the clock of the file."""
    arrays: dict[str, Array]
    """Those of `time`, `position`, `velocity`, `body/…`, `input/…` that are there."""
    rounding: dict[str, float]
    """By how much the numbers of each array may be rounded, in their own unit."""
    index: NDArray[np.int64] | None
    """Numbers of the trajectories, if the file tells them."""
    facts: dict[str, Any]
    """Those of `FACTS` that are there."""
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


@dataclass(frozen=True, eq=False)
class _Piece:
    """Some trajectories as they were read, before they are held against the scene."""

    arrays: dict[str, NDArray[Any]]
    rounding: dict[str, float]
    facts: dict[str, Any]
    first: int = 0
    total: int = 1


def read_foreign(path: Path, scene: Scene | None) -> Iterator[Foreign]:
    """Read a file of trajectories, some at a time.

    Args:
        path: `.csv`: one trajectory; `.npz`, `.h5` or `.hdf5`: one or more.
        scene: What moves; None: what the file itself says.

    Raises:
        InputError: It cannot be read, or is no trajectory of the scene.
    """
    if path.suffix not in (".csv", ".npz", ".h5", ".hdf5"):
        msg = f"{path}: got a file {path.suffix or 'without ending'}, allowed is .npz, .csv, .h5"
        raise InputError(msg)
    refuse_other(path)
    try:
        for piece in _pieces_of(path, scene):
            yield _checked(piece, scene or _own_scene(piece, path), str(path))
    except _DAMAGE as error:
        msg = f"{path} cannot be read as {path.suffix[1:]} ({error}); it is something else"
        raise InputError(msg) from error


def _pieces_of(path: Path, scene: Scene | None) -> Iterator[_Piece]:
    if path.suffix == ".csv":
        yield _Piece(*read_csv(path, scene))
    elif path.suffix == ".npz":
        yield from _read_npz(path)
    else:
        yield from _read_hdf5(path)


def _read_hdf5(path: Path) -> Iterator[_Piece]:
    """Read arrays by their paths and attributes as facts; of other datasets only the names."""
    with open_hdf5(path) as file:
        sources = datasets_in(file)
        for name in _RANKS.keys() & sources.keys():
            check_sources(sources[name])
        yield from _read_rows(sources, plain(file.attrs), path)


def _read_npz(path: Path) -> Iterator[_Piece]:
    """Read arrays by their names; what has no axes is a fact."""
    with ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        refuse_bomb(path, sum(member.file_size for member in archive.infolist()))
        members = {
            name.removesuffix(".npy"): _Member(stack.enter_context(archive.open(name)), path)
            for name in archive.namelist()
        }
        facts = {name: one[()].item() for name, one in members.items() if not one.shape}
        yield from _read_rows({k: one for k, one in members.items() if one.shape}, facts, path)


def _read_rows(sources: Mapping[str, Any], facts: dict[str, Any], path: Path) -> Iterator[_Piece]:
    """Read some trajectories at a time; what belongs to no motion is passed over.

    Args:
        sources: Arrays in a file that give their shape, rows by slices without a gap, and all of
            them by `[()]`.
        facts: What else the file says.
        path: The file.
    """
    strange = [name for name in sources if name not in FIELDS]
    if strange or TIME not in sources:
        got = f"an array {strange[0]!r}" if strange else "no array 'time'"
        allowed = ", ".join((TIME, *(name for name in _RANKS if name != "index")))
        msg = f"{path}: got {got}, allowed are {allowed}"
        raise InputError(msg)
    sources = {name: one for name, one in sources.items() if name in (TIME, *_RANKS)}
    for name, one in sources.items():
        if one.dtype.kind not in "fiu":
            msg = f"{path}: {name}: got values of the type {one.dtype}, allowed are numbers"
            raise InputError(msg)
    many = {name for name, one in sources.items() if len(one.shape) == _RANKS.get(name)}
    if many == {"index"}:
        many = set()  # one trajectory, whose arrays have no such axis
    counts = {name: sources[name].shape[0] for name in sorted(many)}
    _refuse_different(counts, path)
    total = max(counts.values(), default=1)
    if total < 1:
        msg = f"{path}: got no trajectory, allowed is 1 or more"
        raise InputError(msg)
    each = max((math.prod(sources[name].shape[1:3]) for name in many), default=1)
    size = max(1, _AT_ONCE // max(1, each))
    shared = {name: np.asarray(one[()]) for name, one in sources.items() if name not in many}
    for first in range(0, total, size):
        rows = {name: np.asarray(sources[name][first : first + size]) for name in many}
        arrays = shared | rows
        rounding = {name: rounding_of(array) for name, array in arrays.items()}
        yield _Piece(arrays, rounding, facts, first, total)


def _refuse_different(counts: dict[str, int], source: Path | str) -> None:
    if len(set(counts.values())) > 1:
        sizes = ", ".join(f"{name} {count}" for name, count in counts.items())
        msg = f"{source}: got arrays of different numbers of trajectories: {sizes}"
        raise InputError(msg)


class _Member:
    """An array of an npz file, which can be read from its beginning on alone."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self._file = file
        readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        try:
            version = npy.read_magic(file)
        except ValueError as error:
            msg = f"{path}: holds {file.name}, which is no array; allowed are arrays of numbers"
            raise InputError(msg) from error
        if version not in readers:
            msg = f"{path}: holds an array in version {version} of npy, allowed are 1.0 and 2.0"
            raise InputError(msg)
        self.shape, self._by_columns, self.dtype = readers[version](file)
        if self.dtype.hasobject:
            msg = f"{path}: holds Python objects; allowed are arrays of numbers"
            raise InputError(msg)
        self._read: NDArray[Any] | None = None

    def __getitem__(self, rows: slice | tuple[()]) -> NDArray[Any]:
        """Read all of it, or the next rows."""
        if not isinstance(rows, slice):
            return self._whole()
        if self._by_columns:  # rows are all over it
            self._read = self._whole() if self._read is None else self._read
            return self._read[rows]
        return self._take((len(range(*rows.indices(self.shape[0]))), *self.shape[1:]))

    def _whole(self) -> NDArray[Any]:
        if self._by_columns:
            return self._take(self.shape[::-1]).transpose()
        return self._take(self.shape)

    def _take(self, shape: tuple[int, ...]) -> NDArray[Any]:
        wanted = math.prod(shape) * self.dtype.itemsize
        content = self._file.read(wanted)
        if len(content) < wanted:
            msg = "an array ends too early"
            raise EOFError(msg)
        return np.frombuffer(content, self.dtype).reshape(shape)


def _own_scene(piece: _Piece, path: Path) -> Scene:
    if "scene" not in piece.facts:
        msg = f"{path}: the file does not tell its scene; give it with --scene"
        raise InputError(msg)
    return scene_of(piece.facts["scene"], path, "give it with --scene")


def _checked(piece: _Piece, scene: Scene, source: str) -> Foreign:
    """Hold times, shapes and numbers against the scene."""
    if not {"position", "body/position"} & piece.arrays.keys():
        msg = f"{source}: got no positions, allowed are position (of particles) or body/position"
        raise InputError(msg)
    for one, other in (("position", "orientation"), ("velocity", "angular_velocity")):
        if (f"body/{one}" in piece.arrays) != (f"body/{other}" in piece.arrays):
            msg = f"{source}: body/{one} and body/{other} belong together; one is missing"
            raise InputError(msg)
    clock = _clock(np.asarray(piece.arrays[TIME], dtype=np.float64), scene, source)
    frames = np.arange(clock.steps + 1, dtype=np.float64)
    arrays: dict[str, Array] = {TIME: np.asarray(clock.frame * frames)}
    arrays |= _shaped(piece, scene, clock, source)
    facts = {
        key: _fact(key, piece.facts[key], allowed, source)
        for key, allowed in FACTS.items()
        if key in piece.facts
    }
    index = None
    if "index" in piece.arrays:
        given = piece.arrays["index"].ravel().tolist()
        numbers = [_fact("index", number, _NATURAL, source) for number in given]
        index = np.array(numbers, dtype=np.int64)
    found = msgspec.structs.replace(scene, clock=clock)
    return Foreign(
        source, scene, found, arrays, piece.rounding, index, facts, piece.first, piece.total
    )


def _clock(time: Array, scene: Scene, source: str) -> Clock:
    if time.ndim != 1 or len(time) < 2 or not np.isfinite(time).all():
        msg = f"{source}: time: got shape {time.shape}, allowed is one number a frame, 2 or more"
        raise InputError(msg)
    steps = np.diff(time)
    usual = float(np.median(steps))
    off = np.abs(steps - usual)
    if usual <= 0 or off.max() > _SAME_FRAME * usual:
        k = int(off.argmax())
        msg = (
            f"{source}: time is not uniform: frame {k + 1} comes {steps[k]:.6g} s after the one "
            f"before, the median is {usual:.6g} s; resample it, or leave frames out"
        )
        raise InputError(msg)
    frame = scene.clock.frame
    same = abs(usual - frame) <= _SAME_FRAME * frame
    return Clock(frame=frame if same else usual, steps=len(steps))


def _shaped(piece: _Piece, scene: Scene, clock: Clock, source: str) -> dict[str, Array]:
    """Give the arrays a first axis of trajectories and hold their shapes against the scene."""
    found: dict[str, Array] = {}
    for group in groups(scene):
        if group.name not in piece.arrays:
            continue
        values = np.asarray(piece.arrays[group.name], dtype=np.float64)
        per_step = group.name in PER_STEP
        own = group.columns.shape[:1] if group.name == "input/torque" else group.columns.shape
        wanted = (clock.steps + (not per_step), *own)
        values = values[None] if values.ndim == len(wanted) else values
        if values.shape[1:] != wanted:
            shape = ", ".join(map(str, wanted))
            msg = (
                f"{source}: {group.name}: got shape {values.shape}, allowed for {scene.name} is "
                f"(trajectories, {shape}): {'steps' if per_step else 'frames'}, then {group.span}"
            )
            raise InputError(msg)
        _refuse_nan(values, group.name, source, piece.first)
        found[group.name] = values
    _refuse_different({name: len(values) for name, values in found.items()}, source)
    return found


def _refuse_nan(values: Array, name: str, source: str, first: int) -> None:
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, frame = bad[0][:2]
        value = values[tuple(bad[0])]
        msg = (
            f"{source}: {name}: got {value} in trajectory {first + row}, frame {frame}; "
            "allowed are finite numbers: cut the trajectory off before"
        )
        raise InputError(msg)


def _fact(key: str, value: Any, allowed: str, source: str) -> Any:
    try:
        return _READERS[allowed](value)
    except (TypeError, ValueError, OverflowError, KeyError):
        msg = f"{source}: {key}: got {value!r}, allowed is {allowed}"
        raise InputError(msg) from None


def _natural(value: Any) -> int:
    number = int(value)
    if number < 0 or number != float(value):
        raise ValueError
    return number


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError
    return number


def _truth(value: Any) -> bool:
    return {"true": True, "1": True, "false": False, "0": False}[str(value).lower()]


_READERS: dict[str, Callable[[Any], Any]] = {
    _NATURAL: _natural,
    _NUMBER: _finite,
    FACTS["noise"]: _truth,
}
