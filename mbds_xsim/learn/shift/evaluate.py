"""Roll models out on domains, side by side; what was done is kept and not done again."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from mbds_xsim.errors import InputError
from mbds_xsim.isolate import Crash, Task, run_tasks
from mbds_xsim.learn.shift.domains import Domain
from mbds_xsim.learn.shift.measure import Figures, figures_on, read_figures
from mbds_xsim.learn.shift.roster import Entry
from mbds_xsim.learn.shift.sources import sources
from mbds_xsim.reference.cache import directory
from mbds_xsim.scene import Scene

__all__ = ["Plan", "evaluate"]

_TIMEOUT = 4 * 3600.0
_TOGETHER = 6  # models a process: starting one takes seconds
Tell = Callable[[Entry], None]


@dataclass(frozen=True)
class Plan:
    """How long to predict."""

    horizon: int
    """Frames of a rollout."""
    stride: int = 8
    """Frames from a window of the teacher-forced prediction to the next."""


def evaluate(
    scene: Scene,
    entries: Sequence[Entry],
    domains: Sequence[Domain],
    plan: Plan,
    *,
    workers: int | None = None,
    tell: Tell | None = None,
) -> dict[tuple[Entry, str], Figures]:
    """Test every model on every domain.

    Args:
        scene: Of the data.
        entries: Models.
        domains: Test domains.
        plan: How long to predict.
        workers: Processes at a time.
        tell: Told of every model that is done now.

    Raises:
        InputError: A model cannot be tested; those tested before are kept.
    """
    missing = [entry for entry in entries if any(not _kept(entry, d, plan) for d in domains)]
    parts = [missing[k : k + _TOGETHER] for k in range(0, len(missing), _TOGETHER)]
    tasks = [Task(_carry_out, (scene, part, domains, plan), _TIMEOUT) for part in parts]

    def finished(place: int, answer: object) -> None:
        del answer
        if tell is not None:
            for entry in parts[place]:
                tell(entry)

    for part, answer in zip(
        parts, run_tasks(tasks, workers=workers, finished=finished), strict=True
    ):
        if isinstance(answer, Crash):
            msg = f"testing {part[0].path or part[0].model} and others failed: {answer.reason}"
            raise InputError(msg if not answer.refused else answer.reason)
    return {
        (entry, domain.name): _needed(entry, domain, plan)
        for entry in entries
        for domain in domains
    }


def _carry_out(
    scene: Scene, entries: Sequence[Entry], domains: Sequence[Domain], plan: Plan
) -> None:
    torch.set_num_threads(1)
    motions = functools.cache(lambda place, dtype: domains[place].motions(dtype))
    for entry in entries:
        model = entry.load(scene)
        for place, domain in enumerate(domains):
            if not _kept(entry, domain, plan):
                figures = figures_on(
                    model, motions(place, model.dtype), horizon=plan.horizon, stride=plan.stride
                )
                figures.write(_path(entry, domain, plan))


def _kept(entry: Entry, domain: Domain, plan: Plan) -> bool:
    return _path(entry, domain, plan).is_file()


def _needed(entry: Entry, domain: Domain, plan: Plan) -> Figures:
    path = _path(entry, domain, plan)
    found = read_figures(path)
    if found is None:
        msg = f"{path}: cannot be read; remove it and run again"
        raise InputError(msg)
    return found


def _path(entry: Entry, domain: Domain, plan: Plan) -> Path:
    digest = hashlib.sha256(_source(entry.module))
    what = (entry.model, entry.content, domain.name, domain.content, _rows(domain), plan)
    digest.update(repr(what).encode())
    key = digest.hexdigest()
    return directory() / "shift" / key[:2] / f"{key[2:]}.npz"


def _rows(domain: Domain) -> tuple[int, ...]:
    return getattr(domain, "rows", ())


@functools.cache
def _source(module: str) -> bytes:
    """Hash of the code that makes the figures of a model: that of others may change."""
    return sources(module, "mbds_xsim.learn.saved", "mbds_xsim.learn.shift.measure")
