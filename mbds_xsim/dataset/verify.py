"""Check a file or a folder of data again, as someone must who got it from somebody else."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.campaign import ProgressSink
from mbds_xsim.dataset.card import CARD, CROISSANT
from mbds_xsim.dataset.facts import attributes_of
from mbds_xsim.dataset.layout import SUFFIX
from mbds_xsim.dataset.opened import refuse_other
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.reaudit import FileReport, reaudit
from mbds_xsim.dataset.redescribe import described, recheck_card, recheck_metadata
from mbds_xsim.dataset.rejoin import recheck_joined, recheck_joint
from mbds_xsim.errors import InputError
from mbds_xsim.frame import frame_of
from mbds_xsim.isolate import LIMIT, Crash, Task, run_tasks
from mbds_xsim.silence import Silent

__all__ = ["Verified", "verify"]

_TEXTS = {CARD: "card", CROISSANT: "metadata"}
_AGAIN = 3  # trajectories of a shard that are simulated again
_SHARDS_AGAIN = 3  # shards of a variant of which some are


@dataclass(frozen=True)
class Verified:
    """What became of everything that was looked at."""

    path: str
    files: tuple[FileReport, ...]
    about: tuple[dict[str, Any], ...]
    """What is to be known of each variant."""
    wall_s: float
    seed: int
    """Chose which trajectories were simulated again."""

    def to_frame(self) -> Any:
        """Give a `pandas.DataFrame` with a row for each file."""
        return frame_of(self.files)

    @property
    def sound(self) -> bool:
        """Whether everything holds what it says."""
        return not any(report.problems for report in self.files)


def verify(
    path: Path,
    *,
    seed: int | None = None,
    workers: int | None = None,
    limit: float = LIMIT,
    progress: ProgressSink | None = None,
) -> Verified:
    """Check everything again that a file, with its shards, or a folder holds.

    Args:
        path: A data file, or a folder of them.
        seed: Chooses the trajectories that are simulated again; left out, nobody can foresee it.
        workers: Processes at a time; all cores when left out.
        limit: Longest that one file may take [s].
        progress: Where it is told.

    Raises:
        InputError: There is nothing to check.
    """
    begin, progress = time.perf_counter(), progress or Silent()
    files = _files(path)
    kinds = {file: _kind(file) for file in files}
    shards = [file for file, kind in kinds.items() if kind == "shard"]
    seed = secrets.randbits(32) if seed is None else seed
    again = _resimulated(shards, seed)
    tasks = [_task(file, kinds[file], again, seed, limit) for file in files]
    progress.begin(len(tasks))
    answers = run_tasks(
        tasks, workers=workers, finished=lambda place, _: progress.advance(files[place].name)
    )
    reports = [
        FileReport(str(file), kinds[file], 0, (f"cannot be read: {answer.reason}",))
        if isinstance(answer, Crash)
        else answer
        for file, answer in zip(files, answers, strict=True)
    ]
    joined = [file for file, kind in kinds.items() if kind == "joined"]
    loose = _loose(shards, joined) if path.is_dir() else set()
    reports = [_with_loose(report, loose) for report in reports]
    about = tuple(_about(file) for file in joined or shards[:1])
    return Verified(str(path), tuple(reports), about, time.perf_counter() - begin, seed)


def _files(path: Path) -> list[Path]:
    """Give the files to look at: all of a folder, or one and what it joins."""
    if path.is_dir():
        found = sorted(path.rglob(f"*{SUFFIX}"))
        if not found:
            msg = f"{path} holds no {SUFFIX} file; name a folder that mbds-xsim generate has made"
            raise InputError(msg)
        joined = [file for file in found if _kind(file) == "joined"]
        return [*found, *described(joined)]
    refuse_other(path)
    if _kind(path) != "joined":
        return [path]
    try:
        return [path, *load_dataset(path).files]
    except InputError:
        return [path]  # which will be told in its report


def _kind(path: Path) -> str:
    if path.name in _TEXTS:
        return _TEXTS[path.name]
    try:
        return str(attributes_of(path).get("kind"))
    except InputError:
        return "unknown"


def _resimulated(shards: list[Path], seed: int) -> set[Path]:
    """Of each variant some shards, drawn at random."""
    rng, found = np.random.default_rng(seed), set[Path]()
    for folder in dict.fromkeys(shard.parent for shard in shards):
        own = [shard for shard in shards if shard.parent == folder]
        chosen = rng.choice(len(own), min(_SHARDS_AGAIN, len(own)), replace=False)
        found |= {own[k] for k in chosen}
    return found


def _task(file: Path, kind: str, again: set[Path], seed: int, limit: float) -> Task:
    others: dict[str, Callable[[Path], FileReport]] = {
        "joined": recheck_joined,
        "joint": recheck_joint,
        "card": recheck_card,
        "metadata": recheck_metadata,
    }
    path = file.resolve()
    if kind in others:
        return Task(others[kind], (path,), limit)
    return Task(reaudit, (path, _AGAIN if file in again else 0, seed), limit)


def _loose(shards: list[Path], joined: list[Path]) -> set[str]:
    """Shards that no joined file names, as an interrupted run leaves them."""
    named: set[Path] = set()
    for file in joined:
        try:
            named |= {part.resolve() for part in load_dataset(file).files}
        except InputError:
            continue
    return {str(shard.resolve()) for shard in shards if shard.resolve() not in named}


def _with_loose(report: FileReport, loose: set[str]) -> FileReport:
    if report.file not in loose:
        return report
    note = "not joined yet: run mbds-xsim generate again to finish the set"
    return replace(report, notes=(*report.notes, note))


def _about(file: Path) -> dict[str, Any]:
    keys = (
        "scene_name", "engine", "engine_version", "profile", "certification", "method", "step_s",
        "seed", "noise", "count", "published", "rejected", "audit_sample", "mbds_xsim_version",
    )  # fmt: skip
    told = attributes_of(file)
    return {"file": str(file), **{key: told.get(key) for key in keys}}
