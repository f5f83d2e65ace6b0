"""Export of data sets to npz or CSV files, which any program reads, and what it leaves out.

In CSV files a trajectory is a table: a line for each frame, a column for each of its numbers.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import put, tidied
from mbds_xsim.base.isolate import Meter
from mbds_xsim.base.text import in_markdown, on_a_line
from mbds_xsim.dataset.layout import FIELDS, MOTION, SPLITS, attribute
from mbds_xsim.dataset.points import Points, axis_sizes
from mbds_xsim.dataset.read import Dataset, joined_files, load_dataset
from mbds_xsim.dataset.variant import folder_name
from mbds_xsim.scene.scene import Scene

Form = Literal["npz", "csv"]

_FIGURES = "figures of the checks (check/…), starts as drawn (start/…; frame 0 has them)"
_ATTRIBUTES = "checksums, units and axes as attributes"
_REJECTED = "rejected trajectories"

LOST: dict[Form, tuple[str, ...]] = {
    "npz": (_FIGURES, f"{_ATTRIBUTES}; windows without reading the whole file", _REJECTED),
    "csv": (
        _FIGURES,
        f"{_ATTRIBUTES}; any access but reading the whole file",
        _REJECTED,
        "the scene and its graph (scene.toml has the scene), forces without the noise "
        "(input/known_force)",
    ),
}
"""Information that each form does not carry."""

_FACTS = (
    "scene_name", "seed", "noise", "engine", "engine_version", "profile", "certification",
    "method", "method_order", "step_s", "velocity_lag_s", "contact_time_s", "single_precision",
    "mbds_xsim_version",
)  # fmt: skip
_NOT_CARRIED = ("check/", "start/")
_README = "README.md"
_SCENE = "scene.toml"
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
            f"{path}: got {max(len(rows) - 1, 0)} frames, allowed is a line of names and 2 or more"
        )
    names = [name.strip() for name in rows[0]]
    arrays, rounding = dict[str, NDArray[Any]](), dict[str, float]()
    for group in (_TIME, *_sort_columns(scene, names, str(path))):
        frames = rows[1:-1] if FIELDS[group.name].per_step else rows[1:]
        columns = [_column(frames, names.index(name), name, path) for name in group.columns.flat]
        values = np.stack([numbers for numbers, _ in columns], axis=-1)
        arrays[group.name] = values.reshape(len(frames), *group.columns.shape)
        rounding[group.name] = max(error for _, error in columns)
    if "index" in facts:
        arrays["index"] = np.array([attribute("index", facts, f"{path}: ", strict=False)])
    return arrays, facts, rounding


def _column(rows: list[list[str]], place: int, name: str, path: Path) -> tuple[Array, float]:
    """Return the numbers of a column, and their rounding: half a unit of the last digit or more."""
    texts = [row[place].strip() if place < len(row) else "" for row in rows]
    exponents, values = [], []
    for frame, text in enumerate(texts):
        try:
            exponents.append(Decimal(text).as_tuple().exponent)
            values.append(float(text))  # refuses a signalling NaN, unlike Decimal
        except (ArithmeticError, ValueError):
            msg = f"{path}: frame {frame}, column {name}: got {text!r}, allowed is a number"
            raise InputError(msg) from None
    last = min((exponent for exponent in exponents if isinstance(exponent, int)), default=0)
    numbers = np.array(values)
    return numbers, max(0.5 * 10.0**last, _coarse(numbers))


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


@dataclass(frozen=True)
class Exported:
    """Record of an export."""

    out: str
    form: Form
    files: int
    trajectories: int
    bytes: int
    lost: tuple[str, ...]
    absent: dict[str, list[int]]
    """Numbers asked for that are missing because they were rejected, keyed by data file."""


def export(
    path: Path,
    out: Path,
    form: Form,
    *,
    engines: str | None = None,
    numbers: Sequence[int] | None = None,
    progress: Meter,
) -> Exported:
    """Write data sets in another form, with a folder for each scene and variant.

    An npz file holds as many trajectories as a shard, a CSV file holds one.

    Args:
        path: A data file, or a folder of them.
        out: Folder to write to, made if needed.
        form: Form of the files.
        engines: Engines whose data sets are written, comma-separated; all if None.
        numbers: Numbers of the trajectories that are written; all if None.
        progress: Receiver of progress reports.

    Raises:
        InputError: There are no such data, they are not what was written, or the folder holds
            something else.
    """
    sets = {file: load_dataset(file) for file in joined_files(path, engines)}
    absent = {str(file): _absent(data, numbers) for file, data in sets.items()}
    with tidied(_folder(data, out) for data in sets.values()):  # files of killed runs
        for data in sets.values():
            _check_target(data, out, form, numbers)
            data.check()  # damage could not be found later: the form has no checksums
    progress.begin(sum(len(data.files) for data in sets.values()))
    files = count = size = 0
    for data in sets.values():
        folder = _folder(data, out)
        put(folder / _SCENE, data.attributes["scene"].encode())
        put(folder / _README, _readme(data, form).encode())
        for shard in data.files:
            part = load_dataset(shard)
            rows = np.flatnonzero(np.isin(part.index, part.index if numbers is None else numbers))
            for name, content in _WRITERS[form](data, part, rows):
                put(folder / name, content)
                files, size = files + 1, size + len(content)
            count += len(rows)
            progress.advance(shard.name)
    return Exported(str(out), form, files, count, size, LOST[form], absent)


def _folder(data: Dataset, out: Path) -> Path:
    joined = data.attributes["kind"] == "joined"
    variant = data.path.stem if joined else data.path.absolute().parent.name
    return out / folder_name(data.attributes["scene_name"]) / variant


def _absent(data: Dataset, numbers: Sequence[int] | None) -> list[int]:
    """Return the numbers asked for that were rejected; refuse numbers that were never drawn."""
    attrs = data.attributes
    first, end = attrs["first"], attrs["first"] + attrs["count"]
    beyond = [number for number in numbers or () if not first <= number < end]
    if beyond:
        msg = f"--indices: got {beyond[0]}, allowed for {data.path} is {first} … {end - 1}"
        raise InputError(msg)
    missing: list[int] = np.setdiff1d(numbers or (), data.index).tolist()
    return missing


def _check_target(data: Dataset, out: Path, form: Form, numbers: Sequence[int] | None) -> None:
    """Refuse a folder with files that this export does not write: they would look like its own."""
    folder = _folder(data, out)
    if form == "csv":
        names = {_csv_name(int(n)) for n in (data.index if numbers is None else numbers)}
    else:
        ends = np.cumsum([part.rows for part in data.parts])
        rows = np.flatnonzero(np.isin(data.index, data.index if numbers is None else numbers))
        names = {f"{data.files[k].stem}.npz" for k in np.searchsorted(ends, rows, side="right")}
    present = {file.name for file in folder.iterdir()} if folder.is_dir() else set()
    strange = sorted(present - names - {_README, _SCENE})
    if strange:
        msg = f"--out: {folder} holds {strange[0]}, which is not of this export; name another --out"
        raise InputError(msg)


def _csv_name(number: int) -> str:
    return f"{number:010d}.csv"


def _npz(data: Dataset, part: Dataset, rows: NDArray[np.int64]) -> Iterator[tuple[str, bytes]]:
    """Yield a file with the chosen trajectories of a shard, under the names of the data set."""
    if not len(rows):
        return
    arrays: dict[str, Any] = {
        name: part[name][rows] if FIELDS[name].per_trajectory else part[name]
        for name in part
        if not name.startswith(_NOT_CARRIED)
    }
    splits = _splits(data)
    if splits:
        numbers = arrays["index"].tolist()
        arrays["split"] = np.array([splits[number] for number in numbers], dtype=np.uint8)
    arrays |= {key: np.array(part.attributes[key]) for key in (*_FACTS, "scene")}
    arrays = {
        key: values.astype(str) if values.dtype == object else values
        for key, values in arrays.items()
    }
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    yield f"{part.path.stem}.npz", stream.getvalue()


def _csv(data: Dataset, part: Dataset, rows: NDArray[np.int64]) -> Iterator[tuple[str, bytes]]:
    """Yield a file for each trajectory: facts, names of columns, and a row for each frame."""
    splits = _splits(data)
    for row in rows.tolist():
        number = int(part.index[row])
        facts: dict[str, Any] = {"index": number, **{key: part.attributes[key] for key in _FACTS}}
        if splits:
            facts["split"] = SPLITS[splits[number]]
        arrays = {name: part[name][row] for name in MOTION if name in part}
        yield _csv_name(number), csv_of(part.scene, {TIME: part.time, **arrays}, facts)


def _splits(data: Dataset) -> Mapping[int, int]:
    if "split" not in data.small:
        return {}
    return dict(zip(data.index.tolist(), data.small["split"].tolist(), strict=True))


_WRITERS = {"npz": _npz, "csv": _csv}


def _readme(data: Dataset, form: Form) -> str:
    """Return a text that says what the files in the folder are, and what they lack."""
    attrs = in_markdown(data.attributes)
    command = f"mbds-xsim audit FILE.{form}" + (f" --scene {_SCENE}" if form == "csv" else "")
    lost = "".join(f"- {line}\n" for line in LOST[form])
    if form == "npz":
        table = "".join(
            f"| `{field.name}` | {', '.join(field.axes)} | {field.unit} | {field.meaning} |\n"
            for field in FIELDS.values()
            if field.name == "split"
            or ("shard" in field.kinds and not field.name.startswith(_NOT_CARRIED))
        )
        table = f"| array | axes | unit | |\n| --- | --- | --- | --- |\n{table}"
    else:
        table = "| columns | unit | |\n| --- | --- | --- |\n| `time` | s | of each frame |\n"
        table += "".join(
            f"| `{group.span}` | {FIELDS[group.name].unit} | {FIELDS[group.name].meaning} |\n"
            for group in groups(data.scene)
        )
    return f"""# {attrs["scene_name"]} in {attrs["engine"]} {attrs["engine_version"]}: {form} files

Exported from an mbds-xsim data set: method {attrs["method"]} at {attrs["step_s"]:.6g} s, seed
{attrs["seed"]}, {attrs["certification"]}. Bodies, points and hinges are numbered in the order of
`{_SCENE}`, W has z up, quaternions are w, x, y, z.

{table}
Not carried over:

{lost}
`{command}` checks a file again.
"""
