"""Export of data sets to npz or CSV files, which any program reads, and what it leaves out."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import locked, put, tidied
from mbds_xsim.base.isolate import Meter
from mbds_xsim.base.text import in_markdown
from mbds_xsim.dataset.layout import FIELDS, MOTION, SPLITS, rejected_folder
from mbds_xsim.dataset.read import Dataset, joined_files, load_dataset
from mbds_xsim.dataset.table import TIME, csv_of, groups
from mbds_xsim.dataset.variant import folder_name

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
    """Numbers asked for that are not in a data file, keyed by this file."""
    rejected: bool
    """Whether the trajectories are rejected ones; the absent numbers are then published."""


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
    _check_apart(list(sets.values()), out)
    absent = {str(file): _absent(data, numbers) for file, data in sets.items()}
    for data in sets.values():
        _check_target(data, out, form, numbers)
        data.check()  # damage could not be found later: the form has no checksums
    progress.begin(sum(len(data.files) for data in sets.values()))
    files = count = size = 0
    with locked(out), tidied(_folder(data, out) for data in sets.values()):  # files of killed runs
        for data in sets.values():
            _check_target(data, out, form, numbers)  # again, as another export may have ended
        for data in sets.values():
            folder = _folder(data, out)
            put(folder / _SCENE, data.attributes["scene"].encode())
            put(folder / _README, _readme(data, form).encode())
            for shard in data.files:
                part = load_dataset(shard)
                chosen = part.index if numbers is None else numbers
                rows = np.flatnonzero(np.isin(part.index, chosen))
                for name, content in _WRITERS[form](data, part, rows):
                    put(folder / name, content)
                    files, size = files + 1, size + len(content)
                count += len(rows)
                progress.advance(shard.name)
    lost, rejected = _lost(data, form), data.is_rejected  # a rejected file is named, so alone
    return Exported(str(out), form, files, count, size, lost, absent, rejected)


def _folder(data: Dataset, out: Path) -> Path:
    joined = data.attributes["kind"] == "joined"
    variant = data.path.stem if joined else data.path.absolute().parent.name
    folder = out / folder_name(data.attributes["scene_name"]) / variant
    return rejected_folder(folder) if data.is_rejected else folder


def _check_apart(sets: Sequence[Dataset], out: Path) -> None:
    """Refuse data sets of which one would replace another."""
    owners = dict[Path, Path]()
    for data in sets:
        folder = _folder(data, out)
        if (other := owners.setdefault(folder, data.path)) != data.path:
            msg = f"{other} and {data.path} would both be written to {folder}; export one at a time"
            raise InputError(msg)


def _lost(data: Dataset, form: Form) -> tuple[str, ...]:
    return tuple(line for line in LOST[form] if not (data.is_rejected and line == _REJECTED))


def _absent(data: Dataset, numbers: Sequence[int] | None) -> list[int]:
    """Return the numbers asked for that the data lack; refuse numbers that were never drawn."""
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
        chosen = set(data.index.tolist() if numbers is None else numbers)
        names = {_csv_name(number) for number in data.index.tolist() if number in chosen}
    else:
        ends = np.cumsum([part.rows for part in data.parts])
        rows = np.flatnonzero(np.isin(data.index, data.index if numbers is None else numbers))
        names = {f"{data.files[k].stem}.npz" for k in np.searchsorted(ends, rows, side="right")}
    present = {file.name for file in folder.glob("[!.]*")}  # others may be of killed runs
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
    arrays |= {key: np.array(fact) for key, fact in _facts(part).items()}
    arrays["scene"] = np.array(part.attributes["scene"])
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
        facts = {"index": number, **_facts(part)}
        if data.is_rejected:
            facts["reason"] = part.small["reason"][row]
        if splits:
            facts["split"] = SPLITS[splits[number]]
        arrays = {name: part[name][row] for name in MOTION if name in part}
        yield _csv_name(number), csv_of(part.scene, {TIME: part.time, **arrays}, facts)


def _splits(data: Dataset) -> Mapping[int, int]:
    if "split" not in data.small:
        return {}
    return dict(zip(data.index.tolist(), data.small["split"].tolist(), strict=True))


def _facts(part: Dataset) -> dict[str, Any]:
    facts = {key: part.attributes[key] for key in _FACTS}
    return facts | {"certification": part.standing}


_WRITERS = {"npz": _npz, "csv": _csv}


def _readme(data: Dataset, form: Form) -> str:
    """Return a text that says what the files in the folder are, and what they lack."""
    attrs = in_markdown(data.attributes)
    command = f"mbds-xsim audit FILE.{form}" + (f" --scene {_SCENE}" if form == "csv" else "")
    lost = "".join(f"- {line}\n" for line in _lost(data, form))
    if form == "npz":
        table = "".join(
            f"| `{field.name}` | {', '.join(field.axes)} | {field.unit} | {field.meaning} |\n"
            for field in FIELDS.values()
            if (field.name in data if field.name in ("split", "reason") else "shard" in field.kinds)
            and not field.name.startswith(_NOT_CARRIED)
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
{attrs["seed"]}, {data.standing}. Bodies, points and hinges are numbered in the order of
`{_SCENE}`, W has z up, quaternions are w, x, y, z.

{table}
Not carried over:

{lost}
`{command}` checks a file again.
"""
