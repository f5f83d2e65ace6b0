"""Data sets as npz or CSV files, which any program reads; what is lost on the way is said."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import put
from mbds_xsim.base.text import in_markdown
from mbds_xsim.dataset.columns import TIME, csv_of, groups
from mbds_xsim.dataset.layout import FIELDS, MOTION, SPLITS
from mbds_xsim.dataset.read import Dataset, joined_files, load_dataset
from mbds_xsim.dataset.variant import folder_name
from mbds_xsim.measure.running import ProgressSink

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
"""What a form does not carry."""

_FACTS = (
    "scene_name", "seed", "noise", "engine", "engine_version", "profile", "certification",
    "method", "method_order", "step_s", "velocity_lag_s", "contact_time_s", "mbds_xsim_version",
)  # fmt: skip
_NOT_CARRIED = ("check/", "start/")
_README = "README.md"
_SCENE = "scene.toml"


@dataclass(frozen=True)
class Exported:
    """What was written."""

    out: str
    form: Form
    files: int
    trajectories: int
    bytes: int
    lost: tuple[str, ...]
    absent: dict[str, list[int]]
    """Of each data set, the numbers asked for that it has not, since they were rejected."""


def export(
    path: Path,
    out: Path,
    form: Form,
    *,
    engines: str | None = None,
    numbers: Sequence[int] | None = None,
    progress: ProgressSink,
) -> Exported:
    """Write data sets in another form, a folder for each scene and variant.

    npz files hold as many trajectories as the shards, CSV files one each.

    Args:
        path: A data file, or a folder of them.
        out: Folder to write to, made if needed.
        form: Which form.
        engines: Only those of these, comma-separated.
        numbers: Only trajectories of these numbers.
        progress: Where it is told.

    Raises:
        InputError: There is no such data, it is not what was written, or the folder holds
            something else.
    """
    sets = {file: load_dataset(file) for file in joined_files(path, engines)}
    absent = {str(file): _absent(data, numbers) for file, data in sets.items()}
    for data in sets.values():
        _check_target(data, out, form, numbers)
        data.check()  # the form has no checksums by which one could find out later
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
    """Give those of the numbers that were drawn and rejected; refuse those never drawn."""
    attrs = data.attributes
    first, end = attrs["first"], attrs["first"] + attrs["count"]
    beyond = [number for number in numbers or () if not first <= number < end]
    if beyond:
        msg = f"--indices: got {beyond[0]}, allowed for {data.path} is {first} … {end - 1}"
        raise InputError(msg)
    missing: list[int] = np.setdiff1d(
        data.index if numbers is None else numbers, data.index
    ).tolist()
    return missing


def _check_target(data: Dataset, out: Path, form: Form, numbers: Sequence[int] | None) -> None:
    """Refuse a folder with files that this export does not write: they would look like part."""
    folder = _folder(data, out)
    if form == "csv":
        chosen = data.index if numbers is None else numbers
        names = {_csv_name(int(number)) for number in chosen}
    else:
        names = {f"{shard.stem}.npz" for shard in data.files}
    there = {file.name for file in folder.iterdir()} if folder.is_dir() else set()
    strange = sorted(there - names - {_README, _SCENE})
    if strange:
        msg = f"--out: {folder} holds {strange[0]}, which is not of this export; name another --out"
        raise InputError(msg)


def _csv_name(number: int) -> str:
    return f"{number:010d}.csv"


def _npz(data: Dataset, part: Dataset, rows: NDArray[np.int64]) -> Iterator[tuple[str, bytes]]:
    """All trajectories of a shard, under the names of the data set."""
    if not len(rows):
        return
    carried = [
        field
        for field in FIELDS.values()
        if field.name in part and not field.name.startswith(_NOT_CARRIED)
    ]
    arrays: dict[str, Any] = {
        field.name: part[field.name][rows] if field.per_trajectory else part[field.name]
        for field in carried
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
    """A file a trajectory: facts, names of columns, a row a frame."""
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
    """Say in the folder what the files are, and what they lack."""
    attrs = in_markdown(data.attributes)
    command = f"mbds-xsim audit FILE.{form}" + (f" --scene {_SCENE}" if form == "csv" else "")
    lost = "".join(f"- {line}\n" for line in LOST[form])
    if form == "npz":
        names = "".join(
            f"| `{field.name}` | {', '.join(field.axes)} | {field.unit} | {field.meaning} |\n"
            for field in FIELDS.values()
            if field.name == "split"
            or ("shard" in field.kinds and not field.name.startswith(_NOT_CARRIED))
        )
        names = f"| array | axes | unit | |\n| --- | --- | --- | --- |\n{names}"
    else:
        names = "| columns | unit | |\n| --- | --- | --- |\n| `time` | s | of each frame |\n"
        names += "".join(
            f"| `{group.span}` | {FIELDS[group.name].unit} | {FIELDS[group.name].meaning} |\n"
            for group in groups(data.scene)
        )
    return f"""# {attrs["scene_name"]} in {attrs["engine"]} {attrs["engine_version"]}: {form} files

Exported from an mbds-xsim data set: method {attrs["method"]} at {attrs["step_s"]:.6g} s, seed
{attrs["seed"]}, {attrs["certification"]}. Bodies, points and hinges are numbered in the order of
`{_SCENE}`, W has z up, quaternions are w, x, y, z.

{names}
Not carried over:

{lost}
`{command}` checks a file again.
"""
