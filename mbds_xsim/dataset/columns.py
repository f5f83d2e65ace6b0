"""A trajectory as a table: a line a frame, a column for each of its numbers, as in CSV files."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import on_a_line
from mbds_xsim.dataset.layout import FIELDS, attribute
from mbds_xsim.dataset.points import Points, axis_sizes
from mbds_xsim.scene.scene import Scene

TIME = "time"
_COMMENT = "#"
_FORMS = {
    "position": "p{}_{}",
    "velocity": "p{}_v{}",
    "body/position": "b{}_{}",
    "body/orientation": "b{}_q{}",
    "body/velocity": "b{}_v{}",
    "body/angular_velocity": "b{}_w{}",
    "input/force": "b{}_f{}",
    "input/torque": "h{}_t",
}
"""Names of the columns of an array, of the number of a point, body or hinge and its component."""


@dataclass(frozen=True, eq=False)
class Group:
    """The columns of one array."""

    name: str
    """Of the array, as in `docs/dataset-layout.md`."""
    columns: NDArray[np.str_]
    """In the shape of a frame of the array: (point or body, component), or (hinge,)."""

    @property
    def span(self) -> str:
        """First and last column, for people."""
        names = self.columns.ravel()
        return f"{names[0]} … {names[-1]}" if len(names) > 1 else str(names[0])


_TIME = Group(TIME, np.array(TIME))


def groups(scene: Scene) -> list[Group]:
    """Give the columns that a scene's trajectory may have; those without numbers are left out."""
    sizes = axis_sizes(scene)
    letters = {"xyz": "xyz", "wxyz": "wxyz", "axis": ["xyz"[k] for k in Points.of(scene).axes]}
    found = []
    for name, form in _FORMS.items():
        shape = [sizes[axis] for axis in FIELDS[name].axes[2:]]
        components = letters.get(FIELDS[name].axes[-1], [""])
        columns = [form.format(k, c) for k in range(shape[0]) for c in components]
        if columns:
            found.append(Group(name, np.reshape(columns, shape)))
    return found


def _sort_columns(scene: Scene, got: list[str], source: str) -> list[Group]:
    """Tell which arrays the columns of a file are."""
    allowed = groups(scene)
    twice = sorted({name for name in got if got.count(name) > 1})
    known = {TIME} | {str(name) for group in allowed for name in group.columns.ravel()}
    strange = [name for name in got if name not in known]
    if strange or twice or TIME not in got:
        spans = "; ".join(f"{group.span} ({group.name})" for group in allowed)
        wrong = f"column {(strange or twice)[0]!r}" if strange or twice else "no column 'time'"
        again = " twice" if twice and not strange else ""
        msg = f"{source}: got {wrong}{again}, allowed for {scene.name} are time; {spans}"
        raise InputError(msg)
    return [group for group in allowed if _is_given(group, set(got), source)]


def _is_given(group: Group, got: set[str], source: str) -> bool:
    missing = [name for name in group.columns.ravel() if name not in got]
    if missing and len(missing) < group.columns.size:
        msg = f"{source}: {group.name} needs the columns {group.span}, {missing[0]} is missing"
        raise InputError(msg)
    return not missing


def read_csv(
    path: Path, scene: Scene | None
) -> tuple[dict[str, NDArray[Any]], dict[str, str], dict[str, float]]:
    """Read rows of columns, and before them facts, as `# seed: 0`.

    A row of inputs acts from its frame to the next: that of the last frame means nothing.

    Returns:
        Arrays, facts, and by how much the numbers of each array may be rounded.

    Raises:
        InputError: A column is not known, time is missing, or an array is there in part.
    """
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
    arrays, rounding = dict[str, NDArray[Any]](), dict[str, float]()
    for group in (_TIME, *_sort_columns(scene, names, str(path))):
        frames = rows[1:-1] if FIELDS[group.name].per_step else rows[1:]
        read = [_column(frames, names.index(name), name, path) for name in group.columns.flat]
        values = np.stack([numbers for numbers, _ in read], axis=-1)
        arrays[group.name] = values.reshape(len(frames), *group.columns.shape)
        rounding[group.name] = max(off for _, off in read)
    if "index" in facts:
        arrays["index"] = np.array([attribute("index", facts, f"{path}: ", strict=False)])
    return arrays, facts, rounding


def _column(rows: list[list[str]], place: int, name: str, path: Path) -> tuple[Array, float]:
    """Give the numbers of a column, and half a unit of the last digit that is written."""
    texts = [row[place].strip() if place < len(row) else "" for row in rows]
    decimals = []
    for frame, text in enumerate(texts):
        try:
            decimals.append(Decimal(text).as_tuple().exponent)
        except ArithmeticError:
            msg = f"{path}: frame {frame}, column {name}: got {text!r}, allowed is a number"
            raise InputError(msg) from None
    last = min((digit for digit in decimals if isinstance(digit, int)), default=0)
    numbers = np.array([float(text) for text in texts])
    return numbers, max(0.5 * 10.0**last, _coarse(numbers))


def _coarse(numbers: Array) -> float:
    """Rounding of numbers that are float32 written as short as they can be; 0 of others."""
    short = numbers.astype(np.float32)
    return rounding_of(short) if (short.astype(str).astype(np.float64) == numbers).all() else 0.0


def rounding_of(values: NDArray[Any]) -> float:
    """Give by how much values of this type and size may be rounded."""
    if values.dtype.kind != "f":
        return 0.0
    return float(np.finfo(values.dtype).eps / 2 * np.abs(values).max(initial=0.0))


def csv_of(scene: Scene, arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any]) -> bytes:
    """Write what `read_csv` reads, with the shortest texts that read back as the same numbers."""
    there = [_TIME, *(group for group in groups(scene) if group.name in arrays)]
    lines = [f"{_COMMENT} {key}: {on_a_line(str(value))}" for key, value in facts.items()]
    lines.append(",".join(str(name) for group in there for name in group.columns.flat))
    return ("\n".join([*lines, *_lines(there, arrays)]) + "\n").encode()


def _lines(there: list[Group], arrays: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Put columns side by side; inputs have nothing in the last frame."""
    parts = [
        arrays[group.name].astype(str).reshape(-1, group.columns.size).tolist() for group in there
    ]
    for frame in range(len(parts[0])):
        cells = (part[frame] if frame < len(part) else [""] * len(part[0]) for part in parts)
        yield ",".join(text for part in cells for text in part)
