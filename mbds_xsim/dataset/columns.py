"""A trajectory with a column for each of its numbers, as in CSV files."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.points import Points
from mbds_xsim.scene.scene import Scene

Array = NDArray[np.float64]

TIME = "time"
PER_STEP = ("input/force", "input/torque")
"""Arrays of which a row acts from its frame to the next; that of the last frame means nothing."""
_COMMENT = "#"


@dataclass(frozen=True, eq=False)
class Group:
    """The columns of one array."""

    name: str
    """Of the array, as in `docs/dataset-layout.md`."""
    columns: NDArray[np.str_]
    """In the shape of a frame of the array, (point or body or hinge, component)."""

    @property
    def span(self) -> str:
        """First and last column, for people."""
        names = self.columns.ravel()
        return f"{names[0]} … {names[-1]}" if len(names) > 1 else str(names[0])


def groups(scene: Scene) -> list[Group]:
    """Give the columns that a scene's trajectory may have; those without numbers are left out."""
    points = Points.of(scene)
    axes = ["xyz"[k] for k in points.axes]
    bodies, hinges = len(scene.bodies), len(points.mechanism.hinges)
    table = (
        ("position", "p{}_{}", len(points.body), axes),
        ("velocity", "p{}_v{}", len(points.body), axes),
        ("body/position", "b{}_{}", bodies, "xyz"),
        ("body/orientation", "b{}_q{}", bodies, "wxyz"),
        ("body/velocity", "b{}_v{}", bodies, "xyz"),
        ("body/angular_velocity", "b{}_w{}", bodies, "xyz"),
        ("input/force", "b{}_f{}", bodies, "xyz"),
        ("input/torque", "h{}_t{}", hinges, [""]),
    )
    return [
        Group(name, np.array([[form.format(k, c) for c in components] for k in range(count)]))
        for name, form, count, components in table
        if count
    ]


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
) -> tuple[dict[str, NDArray[Any]], dict[str, float], dict[str, str]]:
    """Read rows of columns, and before them facts, as `# seed: 0`.

    Returns:
        Arrays, by how much the numbers of each may be rounded, and facts.

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
    given = _sort_columns(scene, names, str(path))
    per_step = {
        str(name) for group in given if group.name in PER_STEP for name in group.columns.ravel()
    }
    values = {
        name: _column(rows[1:], k, name, path, name in per_step) for k, name in enumerate(names)
    }
    arrays: dict[str, NDArray[Any]] = {TIME: values[TIME][0]}
    rounding = {TIME: values[TIME][1]}
    for group in given:
        columns = [values[name] for name in group.columns.ravel().tolist()]
        series = np.stack([numbers for numbers, _ in columns], axis=-1)
        series = series.reshape(len(series), *group.columns.shape)
        arrays[group.name] = series[:-1] if group.name in PER_STEP else series
        rounding[group.name] = max(off for _, off in columns)
    if "input/torque" in arrays:
        arrays["input/torque"] = arrays["input/torque"][..., 0]
    if "index" in facts:
        arrays["index"] = np.array([facts["index"]])
    return arrays, rounding, facts


def _column(
    rows: list[list[str]], place: int, name: str, path: Path, per_step: bool
) -> tuple[Array, float]:
    """Give the numbers of a column, and half a unit of the last digit that is written."""
    texts = [row[place].strip() if place < len(row) else "" for row in rows]
    if per_step:
        texts[-1] = "0"
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
