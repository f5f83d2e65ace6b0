"""Verification of a data file or a folder, for anyone who received it from somebody else."""

from __future__ import annotations

import io
import json
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import frame_of
from mbds_xsim.base.isolate import LIMIT, USUAL, Conduct, Crash, Task, run_tasks
from mbds_xsim.base.text import counted
from mbds_xsim.dataset.card import CARD, CROISSANT, descriptions, missing_lines
from mbds_xsim.dataset.hdf5 import (
    CONTENT,
    attributes_of,
    check_content,
    datasets_in,
    open_hdf5,
    refuse_other,
    values_of,
)
from mbds_xsim.dataset.layout import ONE_SIZE, SPLITS, SUFFIX, rejected_folder
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.reaudit import FileReport, reaudit
from mbds_xsim.dataset.shard import Shard, joined, joint_datasets
from mbds_xsim.simulate.registry import package_version

_TEXTS = {CARD: "card", CROISSANT: "metadata"}
_FILES = "distribution"  # entry of the metadata that lists files
_AGAIN = 3  # trajectories of a shard that are simulated again
_SHARDS_AGAIN = 3  # shards of a variant from which these are chosen
_OWN = ("kind", "first", "count", "published", "rejected", CONTENT)
"""Attributes that a joined file does not share with its shards."""
_ABOUT = (
    "scene_name", "engine", "engine_version", "profile", "certification", "method", "step_s",
    "seed", "noise", "count", "published", "rejected", "audit_sample", "mbds_xsim_version",
)  # fmt: skip


@dataclass(frozen=True)
class Verified:
    """Outcome of a verification."""

    path: str
    files: tuple[FileReport, ...]
    about: tuple[dict[str, Any], ...]
    """Main attributes of each variant."""
    wall_s: float
    seed: int
    """Seed that chose the trajectories to simulate again."""

    def to_frame(self) -> Any:
        """Return a `pandas.DataFrame` with one row per file."""
        return frame_of(self.files)

    @property
    def sound(self) -> bool:
        """Whether no file has a fault."""
        return not any(report.problems for report in self.files)


def verify(
    path: Path, *, seed: int | None = None, limit: float = LIMIT, conduct: Conduct = USUAL
) -> Verified:
    """Check again everything that a file with its shards, or a folder, holds.

    Args:
        path: A data file, or a folder of them.
        seed: Seed that chooses the trajectories to simulate again; unpredictable if None.
        limit: Time limit of one file [s].
        conduct: Options of the work.

    Raises:
        InputError: There is nothing to check.
    """
    begin, meter = time.perf_counter(), conduct.meter
    facts = _files(path)
    files, kinds = list(facts), {file: str(attrs["kind"]) for file, attrs in facts.items()}
    shards = [file for file, kind in kinds.items() if kind == "shard"]
    joined = [file for file, kind in kinds.items() if kind == "joined"]
    seed = secrets.randbits(32) if seed is None else seed
    resimulated = _resimulated(shards, seed)
    tasks = [
        Task(recheck, (file.resolve(), kind, _AGAIN if file in resimulated else 0, seed), limit)
        for file, kind in kinds.items()
    ]
    meter.begin(len(tasks))
    answers = run_tasks(
        tasks, workers=conduct.workers, finished=lambda place, _: meter.advance(files[place].name)
    )
    reports = tuple(
        FileReport(str(file), kinds[file], problems=[f"cannot be read: {answer.reason}"])
        if isinstance(answer, Crash)
        else answer
        for file, answer in zip(files, answers, strict=True)
    )
    loose = _loose(shards, joined) if path.is_dir() else set()
    for report in reports:
        if report.file in loose:
            report.notes.append("not joined yet: run mbds-xsim generate again to finish the set")
        report.notes.extend(_unequal(Path(report.file), facts))
    variants = tuple(
        {"file": str(file), **{key: facts[file].get(key) for key in _ABOUT}}
        for file in joined or shards[:1]
    )
    return Verified(str(path), reports, variants, time.perf_counter() - begin, seed)


def _files(path: Path) -> dict[Path, dict[str, Any]]:
    """Return files and their attributes: all in a folder, or one and the shards that it joins."""
    if path.is_dir():
        facts = {file: _attributes(file) for file in sorted(path.rglob(f"*{SUFFIX}"))}
        if not facts:
            msg = f"{path} holds no {SUFFIX} file; name a folder that mbds-xsim generate has made"
            raise InputError(msg)
        joined = (file for file, attrs in facts.items() if attrs["kind"] == "joined")
        folders = dict.fromkeys(file.parent for file in joined)
        texts = (folder / name for folder in folders for name in _TEXTS)
        return facts | {text: {"kind": _TEXTS[text.name]} for text in texts if text.is_file()}
    refuse_other(path)
    files = [path]
    if _attributes(path)["kind"] == "joined":
        with suppress(InputError):  # its report will name the fault
            files += load_dataset(path).files
    return {file: _attributes(file) for file in files}


def _attributes(path: Path) -> dict[str, Any]:
    if path.name in _TEXTS:
        return {"kind": _TEXTS[path.name]}
    try:
        return attributes_of(path)
    except InputError:
        return {"kind": "unknown"}


def _resimulated(shards: list[Path], seed: int) -> set[Path]:
    """Draw some shards of each variant at random."""
    rng, drawn = np.random.default_rng(seed), set[Path]()
    for folder in dict.fromkeys(shard.parent for shard in shards):
        own = [shard for shard in shards if shard.parent == folder]
        chosen = rng.choice(len(own), min(_SHARDS_AGAIN, len(own)), replace=False)
        drawn |= {own[k] for k in chosen}
    return drawn


def _loose(shards: list[Path], joined: list[Path]) -> set[str]:
    """Return the shards that no joined file names, such as those of an interrupted run."""
    named: set[Path] = set()
    for file in joined:
        parts = [*file.with_suffix("").glob(f"*{SUFFIX}")]  # used if some are missing
        with suppress(InputError):
            parts = [*load_dataset(file).files]
        named |= {part.resolve() for part in parts}
    return {str(shard.resolve()) for shard in shards if shard.resolve() not in named}


def _unequal(file: Path, facts: dict[Path, dict[str, Any]]) -> Iterator[str]:
    """Yield a note if another set in the folder has more trajectories than this one."""
    sizes = {
        other: int(attrs.get("count", 0))
        for other, attrs in facts.items()
        if attrs["kind"] == "joined" and other.parent == file.parent
    }
    largest = max(sizes, key=sizes.__getitem__, default=file)
    if file in sizes and sizes[file] < sizes[largest]:
        own = counted(sizes[file], "trajectory")
        yield f"{own}, but {largest.name} has {sizes[largest]}: {ONE_SIZE}"


def recheck(path: Path, kind: str, resimulated: int = 0, seed: int = 0) -> FileReport:
    """Check one file by the rules for its kind.

    Some of its trajectories, chosen by the seed, are simulated again if the engine is installed.
    """
    report = FileReport(str(path), kind if kind in _CHECKS else "unknown")
    is_text = kind in _TEXTS.values()
    try:
        fault = None if is_text else check_content(path)
        if fault is not None:
            report.problems.append(f"checksum: {fault}")
        elif kind in _CHECKS:
            _CHECKS[kind](path, report)
        else:
            reaudit(path, report, resimulated, seed)
    except (InputError, OSError, KeyError, ValueError, RuntimeError) as error:
        problem = f"cannot be {'compared' if is_text else 'read'}: {error}"
        return FileReport(report.file, report.kind, problems=[problem])
    return report


def _recheck_joined(path: Path, report: FileReport) -> None:
    """Check a file that joins the shards of a variant, but not the trajectories in the shards."""
    attributes = attributes_of(path)
    with open_hdf5(path) as file:
        index, split = file["index"][()], file["split"][()]
        report.problems += _shards(path, file, attributes)
        if not report.problems:
            shards = [Shard(path.parent / name) for name in values_of(file["shard/file"])]
            report.problems += _differences(file, b"".join(joined(shards, attributes["count"], {})))
    report.problems += _counts(path, index, attributes)
    counts = zip(SPLITS, np.bincount(split, minlength=len(SPLITS)), strict=True)
    report.notes.append(", ".join(f"{name} {count}" for name, count in counts))
    report.trajectories = len(index)


def _shards(path: Path, file: Any, attributes: dict[str, Any]) -> Iterator[str]:
    """Yield faults unless the shards are there, and are the ones that were joined."""
    names = values_of(file["shard/file"])
    for name, content in zip(names, values_of(file["shard/content"]), strict=True):
        part = path.parent / name
        if not part.is_file():
            yield f"shard {name} is missing"
            continue
        other = attributes_of(part)
        if other.get(CONTENT) != content:
            yield f"shard {name} is not the one that was joined"
        yield from _made_differently(f"shard {name}", other, attributes)
    if not len(names):
        yield "index: not that of the shards"


def _made_differently(
    name: str, attributes: dict[str, Any], wanted: dict[str, Any]
) -> Iterator[str]:
    differing = [k for k in wanted if k not in _OWN and attributes.get(k) != wanted[k]]
    if differing:
        yield f"{name} was made differently: {', '.join(differing)}"


def _differences(file: Any, content: bytes) -> Iterator[str]:
    """Yield the datasets that differ from those of a file that joins the same shards."""
    with h5py.File(io.BytesIO(content)) as wanted:
        for name, dataset in datasets_in(wanted).items():
            got = file.get(name)
            form = dataset.is_virtual, dataset.shape
            if not isinstance(got, h5py.Dataset) or (got.is_virtual, got.shape) != form:
                yield f"{name}: does not join the shards"
            elif got.dtype != dataset.dtype:
                yield f"{name}: has the type {got.dtype}, not {dataset.dtype}"
            elif dataset.is_virtual and _sources(got) != _sources(dataset):
                yield f"{name}: takes its rows from elsewhere than the shards"
            elif not dataset.is_virtual and not np.array_equal(got[()], dataset[()]):
                yield f"{name}: not that of the shards"


def _sources(dataset: Any) -> list[tuple[Any, ...]]:
    """List file, dataset, first and last index of each part of a virtual dataset."""
    parts = dataset.virtual_sources() if dataset.size else []
    return [
        (part.file_name, part.dset_name.strip("/"), *part.vspace.get_select_bounds())
        for part in parts
    ]


def _counts(path: Path, index: Any, attributes: dict[str, Any]) -> Iterator[str]:
    """Yield faults unless published and rejected trajectories make up all drawn ones, each once."""
    drawn, published = attributes["count"], attributes["published"]
    if published != len(index) or published + attributes["rejected"] != drawn:
        yield "counts: published and rejected do not make up count"
    if len(index) and (index[0] < 0 or index[-1] >= drawn or (np.diff(index) < 1).any()):
        yield f"index: not ascending from 0 to {drawn - 1}"
    folder = rejected_folder(path.absolute().with_suffix(""))
    if not folder.is_dir():
        return
    parts = [index]
    for part in sorted(folder.glob(f"*{SUFFIX}")):
        yield from _made_differently(f"rejected {part.name}", attributes_of(part), attributes)
        with open_hdf5(part) as file:
            parts.append(file["index"][()])
    if not np.array_equal(np.sort(np.concatenate(parts)), np.arange(drawn)):
        yield f"published and rejected trajectories do not make up 0 to {drawn - 1}"


def _recheck_joint(path: Path, report: FileReport) -> None:
    """Check a joint file: which trajectories are valid in each variant of the folder and in all."""
    wanted = joint_datasets(path.parent)
    with open_hdf5(path) as file:
        stored = {name: values_of(file[name]) for name in wanted}
    if stored["variant"].tolist() != wanted["variant"].tolist():
        about, beside = (", ".join(sets["variant"]) for sets in (stored, wanted))
        report.problems.append(f"lists {about}; its folder has {beside}")
    else:
        report.problems += [
            f"{name}: not what the data sets in its folder give"
            for name, values in wanted.items()
            if not np.array_equal(stored[name], values)
        ]
    report.trajectories = int(stored["valid_in_all"].sum())


def _recheck_card(path: Path, report: FileReport) -> None:
    """Check that a card has all lines that the data give, in order; others may have been added."""
    wanted = descriptions(path.parent)
    differing = [
        f"does not say what the data give, first line {number}: {line[:100]!r}"
        for number, line in missing_lines(path.read_bytes().decode(), wanted[CARD].decode())
    ]
    _tell_differing(report, differing, wanted)


def _recheck_metadata(path: Path, report: FileReport) -> None:
    """Check that metadata have all entries that the data give; others may have been added."""
    metadata, wanted = json.loads(path.read_bytes()), descriptions(path.parent)
    if not isinstance(metadata, dict):
        report.problems.append("is no Croissant metadata")
        return
    _tell_differing(report, [*_differing_entries(metadata, json.loads(wanted[CROISSANT]))], wanted)


def _tell_differing(report: FileReport, differing: list[str], wanted: dict[str, bytes]) -> None:
    """Report differences; of data of another version, only those in the list of files."""
    here = f"mbds-xsim {package_version('mbds-xsim')}"
    if differing and here not in wanted[CARD].decode():
        differing = [each for each in differing if each.startswith(_FILES)]
        note = f"{report.kind}: texts not compared, as the data are not from the installed {here}"
        report.notes.append(note)
    report.problems += differing


def _differing_entries(metadata: dict[str, Any], wanted: dict[str, Any]) -> Iterator[str]:
    """Compare entries with those that the data give, those about files one by one."""
    for key, value in wanted.items():
        listed = metadata.get(key)
        if key not in metadata:
            yield f"{key} is missing"
        elif key != _FILES or not isinstance(listed, list):
            if listed != value:
                yield f"{key}: not what the data give"
        else:
            named = {str(one.get("@id")): one for one in reversed(listed) if isinstance(one, dict)}
            for node in value:
                entry = named.get(node["@id"], {})
                if entry != node:
                    keys = ", ".join(each for each in node if entry.get(each) != node[each])
                    yield f"{_FILES}: {node['@id']}: {keys}: not what the data give"
            if len(listed) != len(value):
                yield f"{_FILES}: lists {len(listed)} files, here are {len(value)}"


_CHECKS: dict[str, Callable[[Path, FileReport], None]] = {
    "joined": _recheck_joined,
    "joint": _recheck_joint,
    "card": _recheck_card,
    "metadata": _recheck_metadata,
}
