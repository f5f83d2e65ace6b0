"""CSV files: a trajectory as a table with a line for each frame, a column for each number."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import counted, on_a_line
from mbds_xsim.dataset.layout import FIELDS
from mbds_xsim.dataset.points import Points, axis_sizes
from mbds_xsim.scene.scene import Scene

TIME = "time"
_COMMENT = "#"
_MOST = 0.6  # share of numbers; others may lack digits that are 0
_SEVERAL = 4  # digits; numbers of fewer may well be exact
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
"""Templates of column names, for a number (of a point, body or hinge) and a component."""


@dataclass(frozen=True, eq=False)
class Group:
    """The columns of one array."""

    name: str
    """Name of the array, as in `docs/dataset-layout.md`."""
    columns: NDArray[np.str_]
    """Column names in the shape of a frame: (point or body, component), (hinge,), () for time."""

    @property
    def span(self) -> str:
        """First and last column, as text for people."""
        names = self.columns.ravel()
        return f"{names[0]} … {names[-1]}" if len(names) > 1 else str(names[0])


_TIME = Group(TIME, np.array(TIME))


def groups(scene: Scene) -> list[Group]:
    """Return the groups of columns that a scene's trajectory may have, without empty ones."""
    sizes = axis_sizes(scene)
    letters = {"xyz": "xyz", "wxyz": "wxyz", "axis": ["xyz"[k] for k in Points.of(scene).axes]}
    column_groups = []
    for name, form in _FORMS.items():
        shape = [sizes[axis] for axis in FIELDS[name].axes[2:]]
        components = letters.get(FIELDS[name].axes[-1], [""])
        columns = [form.format(k, c) for k in range(shape[0]) for c in components]
        if columns:
            column_groups.append(Group(name, np.reshape(columns, shape)))
    return column_groups


def _sort_columns(scene: Scene, names: list[str], source: str) -> list[Group]:
    """Return the arrays to which the columns of a file belong; refuse unknown or repeated ones."""
    allowed = groups(scene)
    twice = sorted({name for name in names if names.count(name) > 1})
    known = {TIME} | {str(name) for group in allowed for name in group.columns.ravel()}
    strange = [name for name in names if name not in known]
    if strange or twice or TIME not in names:
        spans = "; ".join(f"{group.span} ({group.name})" for group in allowed)
        wrong = f"column {(strange or twice)[0]!r}" if strange or twice else "no column 'time'"
        again = " twice" if twice and not strange else ""
        msg = f"{source}: got {wrong}{again}, allowed for {scene.name} are time; {spans}"
        raise InputError(msg)
    return [group for group in allowed if _is_present(group, set(names), source)]


def _is_present(group: Group, names: set[str], source: str) -> bool:
    missing = [name for name in group.columns.ravel() if name not in names]
    if missing and len(missing) < group.columns.size:
        msg = f"{source}: {group.name} needs the columns {group.span}, {missing[0]} is missing"
        raise InputError(msg)
    return not missing


def read_csv(
    path: Path, scene: Scene | None
) -> tuple[dict[str, NDArray[Any]], dict[str, str], dict[str, float]]:
    """Read a table of numbers, and facts in the lines before it, such as `# seed: 0`.

    The inputs in a row act from its frame to the next one; those in the last row mean nothing.

    Returns:
        Arrays, facts, and the largest rounding error of each array.

    Raises:
        InputError: The scene, the time or part of an array is missing, or a column is not known.
    """
    if scene is None:
        raise InputError(f"{path}: a CSV file does not contain its scene; give it with --scene")
    lines = path.read_text("utf-8-sig").splitlines()
    comments = [line.lstrip(_COMMENT).partition(":") for line in lines if line.startswith(_COMMENT)]
    facts = {key.strip(): text.strip() for key, _, text in comments}
    rows = list(csv.reader(line for line in lines if line and not line.startswith(_COMMENT)))
    if len(rows) < 3:
        raise InputError(
            f"{path}: got {counted(max(len(rows) - 1, 0), 'frame')}, "
            "allowed is a line of names and 2 or more"
        )
    names = [name.strip() for name in rows[0]]
    for frame, row in enumerate(rows[1:]):
        if any(cell.strip() for cell in row[len(names) :]):
            msg = f"{path}: frame {frame}: got {counted(len(row), 'cell')}"
            raise InputError(f"{msg}, allowed are {len(names)}, as names")
    arrays, columns = dict[str, NDArray[Any]](), dict[str, list[_Column]]()
    for group in (_TIME, *_sort_columns(scene, names, str(path))):
        frames = rows[1:-1] if FIELDS[group.name].per_step else rows[1:]
        own = [_column(frames, names.index(name), name, path) for name in group.columns.flat]
        values = np.stack([column.numbers for column in own], axis=-1)
        arrays[group.name] = values.reshape(len(frames), *group.columns.shape)
        columns[group.name] = own
    finest = min(column.rounding for own in columns.values() for column in own)
    rounding = {name: _rounding(arrays[name], own, finest) for name, own in columns.items()}
    return arrays, facts, rounding


@dataclass(frozen=True, eq=False)
class _Column:
    """A column of a file."""

    numbers: Array
    rounding: float
    """Half a unit of the last digit in any of its cells."""
    digits: NDArray[np.int64]
    """Number of significant digits in each cell."""


def _rounding(values: Array, columns: list[_Column], finest: float) -> float:
    """Return the largest rounding error of a group of columns; `finest` if all are 0, 1 or −1.

    A column such as 0.0 in every frame shows few digits without being rounded. So the error is not
    larger than in the largest number of the group if that has as many significant digits as any. It
    is that one, whatever decimals smaller numbers have, if most numbers have as many digits, as
    those of %.6e.
    """
    largest = float(np.abs(values).max())
    plain = bool(np.isin(values, (-1.0, 0.0, 1.0)).all())  # as of bodies that do not turn
    if plain or not math.isfinite(largest):
        return finest
    digits = np.stack([column.digits for column in columns], axis=-1)
    sizes, most = np.abs(values.reshape(digits.shape)), int(digits.max())
    order = math.floor(math.log10(largest))
    full = digits == most
    even = most >= _SEVERAL and full[sizes > 0].mean() > _MOST and full[sizes >= 10.0**order].any()
    decimals = math.inf if even else max(column.rounding for column in columns)
    last = order + 1 - most
    return max(min(decimals, 0.5 * 10.0**last), _coarse(values))


def _column(rows: list[list[str]], place: int, name: str, path: Path) -> _Column:
    """Read the numbers of a column, and the digits that they have."""
    texts = [row[place].strip() if place < len(row) else "" for row in rows]
    exponents, digits, values = [], [], []
    for frame, text in enumerate(texts):
        try:
            parts = Decimal(text).as_tuple()
            exponents.append(parts.exponent)
            digits.append(len(parts.digits))
            values.append(float(text))  # refuses a signalling NaN, unlike Decimal
        except (ArithmeticError, ValueError):
            msg = f"{path}: frame {frame}, column {name}: got {text!r}, allowed is a number"
            raise InputError(msg) from None
    last = min((exponent for exponent in exponents if isinstance(exponent, int)), default=0)
    return _Column(np.array(values), 0.5 * 10.0 ** min(last, 300), np.array(digits))


def _coarse(numbers: Array) -> float:
    """Return the rounding of numbers that are float32 values in their shortest form, else 0."""
    short = numbers.astype(np.float32)
    return rounding_of(short) if (short.astype(str).astype(np.float64) == numbers).all() else 0.0


def rounding_of(values: NDArray[Any]) -> float:
    """Return the largest rounding error of values of this type and size; 0 for integers."""
    if values.dtype.kind != "f":
        return 0.0
    return float(np.finfo(values.dtype).eps / 2 * np.abs(values).max(initial=0.0))


def csv_of(scene: Scene, arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any]) -> bytes:
    """Encode a table for `read_csv`, with the shortest texts that read back as the same numbers."""
    present = [_TIME, *(group for group in groups(scene) if group.name in arrays)]
    lines = [f"{_COMMENT} {key}: {on_a_line(str(value))}" for key, value in facts.items()]
    lines.append(",".join(str(name) for group in present for name in group.columns.flat))
    return ("\n".join([*lines, *_lines(present, arrays)]) + "\n").encode()


def _lines(present: list[Group], arrays: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Yield rows with all columns side by side; cells of inputs are empty in the last frame."""
    parts = [
        arrays[group.name].astype(str).reshape(-1, group.columns.size).tolist() for group in present
    ]
    for frame in range(len(parts[0])):
        cells = (part[frame] if frame < len(part) else [""] * len(part[0]) for part in parts)
        yield ",".join(text for part in cells for text in part)
