"""Have shards made by processes, also by engines that crash theirs."""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from mbds_xsim.dataset.shard import SHARD_TIMEOUT, Crashes, claim, make_shards, try_out
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.errors import InputError
from mbds_xsim.isolate import Crash, Task

__all__ = ["Carrier", "make"]

_TRAJECTORY_TIMEOUT = 600.0  # [s]
_TRIES = 2

Job = tuple[Variant, Item]


class Carrier(Protocol):
    """What carries tasks out: `mbds_xsim.isolate.run_tasks`, or a cluster."""

    def __call__(
        self,
        tasks: Sequence[Task],
        *,
        workers: int | None = None,
        finished: Callable[[int, Any], None] | None = None,
    ) -> list[Any]:
        """Give one answer a task, or a `Crash`; in the order of the tasks."""


def make(jobs: Sequence[Job], out: Path, *, workers: int, carry_out: Carrier) -> None:
    """Make shards; those that are there when this ends abnormally are complete.

    Each process makes shards of one variant, the next that no other has claimed. Where one ends
    without an answer the shard is tried again, for it may have been killed from outside. Where
    that ends again the trajectories that end it are looked for and rejected.

    Raises:
        InputError: One cannot be written, or cannot be made at all.
    """
    todo = list(jobs)
    tries: Counter[Job] = Counter()
    crashes: dict[Job, Crashes] = {}
    idle = 0  # rounds in which processes ended before they came to anything
    while todo:
        with _claims(out) as claims:
            tasks = list(_tasks(todo, crashes, out, claims, workers))
            answers = carry_out(tasks, workers=workers, finished=_refuse)
            left = [job for job in todo if _missing(*job, out)]
            guilty = [job for job in left if not claim(claims, *job)]
        idle = 0 if guilty or len(left) < len(todo) else idle + 1
        if idle > _TRIES:
            raise InputError(_despair(*left[0], answers))
        for job in guilty:
            tries[job] += 1
            if tries[job] == _TRIES:
                crashes[job] = _crashes(*job, workers, carry_out)
            elif tries[job] > _TRIES:
                raise InputError(_despair(*job, answers))
        todo = left


@contextmanager
def _claims(out: Path) -> Iterator[Path]:
    """Give an empty folder in which processes claim shards."""
    folder = out / ".claims"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _tasks(
    jobs: Sequence[Job], crashes: dict[Job, Crashes], out: Path, claims: Path, workers: int
) -> Iterator[Task]:
    for variant in dict.fromkeys(variant for variant, _ in jobs):
        work = [(item, crashes.get((other, item), {})) for other, item in jobs if other is variant]
        task = Task(make_shards, (variant, work, out, claims), math.inf)
        yield from [task] * max(1, min(workers, len(work)))


def _refuse(_place: int, answer: Any) -> None:
    """End everything at once where a worker was refused, as by a full disk."""
    if isinstance(answer, Crash) and answer.refused:
        raise InputError(answer.reason)


def _crashes(variant: Variant, item: Item, workers: int, carry_out: Carrier) -> Crashes:
    """Find the trajectories that end the engine's process, by halving."""
    found: dict[int, str] = {}
    groups = [list(item.indices)]
    while groups:
        tasks = [Task(try_out, (variant, group), _patience(len(group))) for group in groups]
        answers = carry_out(tasks, workers=workers)
        guilty = [
            (group, answer.reason)
            for group, answer in zip(groups, answers, strict=True)
            if isinstance(answer, Crash)
        ]
        found |= {group[0]: reason for group, reason in guilty if len(group) == 1}
        larger = [group for group, _ in guilty if len(group) > 1]
        groups = [half for group in larger for half in _halves(group)]
    return found


def _patience(count: int) -> float:
    """Give the longest that so many trajectories may take [s]: no longer than a whole shard may."""
    return min(_TRAJECTORY_TIMEOUT * count, SHARD_TIMEOUT)


def _halves(group: list[int]) -> tuple[list[int], list[int]]:
    middle = len(group) // 2
    return group[:middle], group[middle:]


def _missing(variant: Variant, item: Item, out: Path) -> bool:
    return not (variant.folder(out) / item.file_name).exists()


def _despair(variant: Variant, item: Item, answers: Sequence[Any]) -> str:
    reasons = [answer.reason for answer in answers if isinstance(answer, Crash)]
    reason = reasons[0] if reasons else "its file is not where it was put"
    return (
        f"{variant.scene.name} {variant.name}: the trajectories {item.first} to "
        f"{item.indices[-1]} cannot be made: {reason}"
    )
