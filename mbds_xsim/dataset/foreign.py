"""A trajectory from anywhere: npz, HDF5 or CSV in documented names, held against its scene."""

from __future__ import annotations

import csv
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.columns import HELD, TIME, groups, sort_columns
from mbds_xsim.dataset.facts import scene_of
from mbds_xsim.dataset.layout import known_names
from mbds_xsim.dataset.opened import refuse_other
from mbds_xsim.dataset.streams import RANKS, Piece, read_hdf5, read_npz
from mbds_xsim.errors import InputError
from mbds_xsim.scene import Clock, Scene

__all__ = ["FACTS", "Foreign", "read_foreign"]

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
_COMMENT = "#"


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
class _Raw:
    """What was read, before anything is known of the scene's shapes."""

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
    readers = {".csv": _read_csv, ".npz": _read_npz, ".h5": _read_hdf5, ".hdf5": _read_hdf5}
    if path.suffix not in readers:
        msg = f"{path}: got a file {path.suffix or 'without ending'}, allowed is .npz, .csv, .h5"
        raise InputError(msg)
    refuse_other(path)
    try:
        for raw in readers[path.suffix](path, scene):
            yield _checked(raw, scene or _own_scene(raw, path), str(path))
    except _DAMAGE as error:
        msg = f"{path} cannot be read as {path.suffix[1:]} ({error}); it is something else"
        raise InputError(msg) from error


def _read_csv(path: Path, scene: Scene | None) -> Iterator[_Raw]:
    """Rows of columns, and before them facts, as `# seed: 0`."""
    if scene is None:
        msg = f"{path}: a CSV file does not tell its scene; give it with --scene"
        raise InputError(msg)
    lines = path.read_text("utf-8-sig").splitlines()
    said = [line.lstrip(_COMMENT).partition(":") for line in lines if line.startswith(_COMMENT)]
    facts = {key.strip(): text.strip() for key, _, text in said}
    rows = list(csv.reader(line for line in lines if line and not line.startswith(_COMMENT)))
    if len(rows) < 3:
        msg = (
            f"{path}: got {max(len(rows) - 1, 0)} frames, allowed is a line of names and 2 or more"
        )
        raise InputError(msg)
    names = [name.strip() for name in rows[0]]
    found = sort_columns(scene, names, str(path))
    held = {str(name) for group in found if group.name in HELD for name in group.columns.ravel()}
    values = {name: _column(rows[1:], k, name, path, name in held) for k, name in enumerate(names)}
    arrays: dict[str, NDArray[Any]] = {TIME: values[TIME][0]}
    rounding = {TIME: values[TIME][1]}
    for group in found:
        columns = [values[name] for name in group.columns.ravel().tolist()]
        series = np.stack([numbers for numbers, _ in columns], axis=-1)
        series = series.reshape(len(series), *group.columns.shape)
        arrays[group.name] = series[:-1] if group.name in HELD else series
        rounding[group.name] = max(off for _, off in columns)
    if "input/torque" in arrays:
        arrays["input/torque"] = arrays["input/torque"][..., 0]
    if "index" in facts:
        arrays["index"] = np.array([_fact("index", facts["index"], _NATURAL, str(path))])
    yield _Raw(arrays, rounding, facts)


def _column(
    rows: list[list[str]], place: int, name: str, path: Path, held: bool
) -> tuple[Array, float]:
    """Give the numbers of a column, and half a unit of the last digit that is written."""
    texts = [row[place].strip() if place < len(row) else "" for row in rows]
    if held:
        texts[-1] = "0"
    try:
        decimals = [Decimal(text).as_tuple().exponent for text in texts]
    except ArithmeticError:
        bad = next(k for k, text in enumerate(texts) if not _is_number(text))
        msg = f"{path}: frame {bad}, column {name}: got {texts[bad]!r}, allowed is a number"
        raise InputError(msg) from None
    last = min((digit for digit in decimals if isinstance(digit, int)), default=0)
    numbers = np.array([float(text) for text in texts])
    return numbers, max(0.5 * 10.0**last, _coarse(numbers))


def _coarse(numbers: Array) -> float:
    """Rounding of numbers that are float32 written as short as they can be; 0 of others."""
    short = numbers.astype(np.float32)
    return _rounding(short) if (short.astype(str).astype(np.float64) == numbers).all() else 0.0


def _is_number(text: str) -> bool:
    try:
        Decimal(text)
    except ArithmeticError:
        return False
    return True


def _read_npz(path: Path, _scene: Scene | None) -> Iterator[_Raw]:
    yield from (_named(piece, path) for piece in read_npz(path))


def _read_hdf5(path: Path, _scene: Scene | None) -> Iterator[_Raw]:
    yield from (_named(piece, path) for piece in read_hdf5(path))


def _named(piece: Piece, path: Path) -> _Raw:
    """Sort arrays by name; what belongs to a data set but not to its motion is passed over."""
    values = piece.values
    strange = [name for name in values if name not in known_names()]
    if strange or TIME not in values:
        got = f"an array {strange[0]!r}" if strange else "no array 'time'"
        msg = f"{path}: got {got}, allowed are {', '.join(_ARRAYS)}"
        raise InputError(msg)
    arrays = {name: values[name] for name in (*_ARRAYS, "index") if name in values}
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            msg = f"{path}: {name}: got values of the type {array.dtype}, allowed are numbers"
            raise InputError(msg)
    rounding = {name: _rounding(array) for name, array in arrays.items()}
    return _Raw(arrays, rounding, piece.facts, piece.first, piece.total)


def _rounding(values: NDArray[Any]) -> float:
    if values.dtype.kind != "f":
        return 0.0
    return float(np.finfo(values.dtype).eps / 2 * np.abs(values).max(initial=0.0))


_ARRAYS = (TIME, *(name for name in RANKS if name != "index"))


def _own_scene(raw: _Raw, path: Path) -> Scene:
    if "scene" not in raw.facts:
        msg = f"{path}: the file does not tell its scene; give it with --scene"
        raise InputError(msg)
    return scene_of(raw.facts["scene"], path, "give it with --scene")


def _checked(raw: _Raw, scene: Scene, source: str) -> Foreign:
    """Hold times, shapes and numbers against the scene."""
    if not {"position", "body/position"} & raw.arrays.keys():
        msg = f"{source}: got no positions, allowed are position (of particles) or body/position"
        raise InputError(msg)
    if ("body/position" in raw.arrays) != ("body/orientation" in raw.arrays):
        msg = f"{source}: body/position and body/orientation belong together; one is missing"
        raise InputError(msg)
    if ("body/velocity" in raw.arrays) != ("body/angular_velocity" in raw.arrays):
        msg = f"{source}: body/velocity and body/angular_velocity belong together; one is missing"
        raise InputError(msg)
    clock = _clock(np.asarray(raw.arrays[TIME], dtype=np.float64), scene, source)
    frames = np.arange(clock.steps + 1, dtype=np.float64)
    arrays: dict[str, Array] = {TIME: np.asarray(clock.frame * frames)}
    arrays |= _shaped(raw, scene, clock, source)
    facts = {
        key: _fact(key, raw.facts[key], allowed, source)
        for key, allowed in FACTS.items()
        if key in raw.facts
    }
    index = None
    if "index" in raw.arrays:
        given = raw.arrays["index"].ravel().tolist()
        numbers = [_fact("index", number, _NATURAL, source) for number in given]
        index = np.array(numbers, dtype=np.int64)
    found = msgspec.structs.replace(scene, clock=clock)
    return Foreign(source, scene, found, arrays, raw.rounding, index, facts, raw.first, raw.total)


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


def _shaped(raw: _Raw, scene: Scene, clock: Clock, source: str) -> dict[str, Array]:
    """Give the arrays a first axis of trajectories and hold their shapes against the scene."""
    found: dict[str, Array] = {}
    for group in groups(scene):
        if group.name not in raw.arrays:
            continue
        values = np.asarray(raw.arrays[group.name], dtype=np.float64)
        held = group.name in HELD
        own = group.columns.shape[:1] if group.name == "input/torque" else group.columns.shape
        wanted = (clock.steps + (not held), *own)
        values = values[None] if values.ndim == len(wanted) else values
        if values.shape[1:] != wanted:
            shape = ", ".join(map(str, wanted))
            msg = (
                f"{source}: {group.name}: got shape {values.shape}, allowed for {scene.name} is "
                f"(trajectories, {shape}): {'steps' if held else 'frames'}, then {group.span}"
            )
            raise InputError(msg)
        _refuse_nan(values, group.name, source, raw.first)
        found[group.name] = values
    counts = {len(values) for values in found.values()}
    if len(counts) > 1:
        sizes = ", ".join(f"{name} {len(values)}" for name, values in found.items())
        msg = f"{source}: got arrays of different numbers of trajectories: {sizes}"
        raise InputError(msg)
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
