"""Roll models out on domains, side by side; what was done is kept and not done again."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from mbds_xsim.errors import InputError
from mbds_xsim.isolate import Crash, Task, run_tasks
from mbds_xsim.learn.accelerate import process_count, put
from mbds_xsim.learn.model import Model
from mbds_xsim.learn.shift.domains import Domain
from mbds_xsim.learn.shift.measure import Figures, figures_on, read_figures
from mbds_xsim.learn.shift.meter import Meter
from mbds_xsim.learn.shift.roster import Entry
from mbds_xsim.reference.cache import directory
from mbds_xsim.scene import Scene
from mbds_xsim.versions import MODELS

__all__ = ["Evaluated", "Plan", "evaluate"]

_TIMEOUT = 4 * 3600.0
_TOGETHER = 6  # models a process: starting one takes seconds
Paths = dict[tuple[Entry, str], Path]
"""Where the figures of a model on a domain are kept."""


@dataclass(frozen=True)
class Plan:
    """What to predict, and where."""

    horizon: int
    """Frames of a rollout."""
    stride: int = 8
    """Frames from a window of the teacher-forced prediction to the next."""
    device: str = "cpu"
    """Of the models."""


def evaluate(
    scene: Scene,
    entries: Sequence[Entry],
    domains: Sequence[Domain],
    plan: Plan,
    *,
    cache: bool = True,
    workers: int | None = None,
    meter: Meter | None = None,
) -> Evaluated:
    """Test every model on every domain.

    Args:
        scene: Of the data.
        entries: Models.
        domains: Test domains.
        plan: How long to predict.
        cache: Whether what was done is kept; else it is done anew.
        workers: Processes at a time.
        meter: Told of every model that is done now.

    Returns:
        Figures by model and domain.

    Raises:
        InputError: A model cannot be tested; those tested before are kept.
    """
    # Named once: code that is edited meanwhile must not make the tasks look elsewhere.
    paths = {(entry, d.name): _path(entry, d, plan) for entry in entries for d in domains}
    if not cache:
        for path in paths.values():
            path.unlink(missing_ok=True)
    missing = [e for e in entries if not all(_is_kept(paths[e, d.name]) for d in domains)]
    parts = [missing[k : k + _TOGETHER] for k in range(0, len(missing), _TOGETHER)]
    tasks = [
        Task(_carry_out, (scene, _places(paths, part), domains, plan), _TIMEOUT) for part in parts
    ]

    if meter is not None and missing:
        meter.begin(len(missing))

    def finished(place: int, answer: object) -> None:
        del answer
        if meter is not None:
            for entry in parts[place]:
                meter.advance(f"{entry.model} {entry.training}")

    for part, answer in zip(
        parts,
        run_tasks(tasks, workers=process_count(workers, plan.device), finished=finished),
        strict=True,
    ):
        if isinstance(answer, Crash):
            msg = f"testing {part[0].path or part[0].model} and others failed: {answer.reason}"
            raise InputError(msg if not answer.refused else answer.reason)
    return Evaluated(paths, len(missing))


class Evaluated(Mapping[tuple[Entry, str], Figures]):
    """Reads figures when they are asked for: those of a large study together fill the memory."""

    def __init__(self, paths: Paths, tested: int) -> None:
        self._paths, self.tested = paths, tested

    def __getitem__(self, key: tuple[Entry, str]) -> Figures:
        found = read_figures(self._paths[key])
        if found is None:
            msg = f"{self._paths[key]}: cannot be read; remove it and run again"
            raise InputError(msg)
        return found

    def __iter__(self) -> Iterator[tuple[Entry, str]]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)


def _is_kept(path: Path) -> bool:
    return read_figures(path) is not None


def _places(paths: Paths, entries: Sequence[Entry]) -> Paths:
    return {key: path for key, path in paths.items() if key[0] in entries}


def _carry_out(scene: Scene, paths: Paths, domains: Sequence[Domain], plan: Plan) -> None:
    torch.set_num_threads(1)

    @functools.cache
    def load(entry: Entry) -> Model:
        model = entry.load(scene)
        put(model, plan.device)
        return model

    for domain in domains:  # outermost, so that the motions of one alone are in memory
        motions = functools.cache(domain.motions)
        for (entry, name), path in paths.items():
            if name == domain.name and not _is_kept(path):
                model = load(entry)
                known = motions(model.dtype)
                figures_on(model, known, **dataclasses.asdict(plan)).write(path)


def _path(entry: Entry, domain: Domain, plan: Plan) -> Path:
    what = (MODELS, entry.model, entry.content, domain.name, domain.content, _rows(domain), plan)
    key = hashlib.sha256(repr(what).encode()).hexdigest()
    return directory() / "shift" / key[:2] / f"{key[2:]}.npz"


def _rows(domain: Domain) -> tuple[int, ...]:
    return getattr(domain, "rows", ())
