"""Have shards made by processes, also by engines that crash theirs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from mbds_xsim.dataset.plan import spans
from mbds_xsim.dataset.shard import Crashes, make_shards, try_out
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.errors import InputError
from mbds_xsim.isolate import Crash, Task

__all__ = ["Carrier", "make"]

_SHARD_TIMEOUT = 3600.0  # [s]
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

    Where a process ends without an answer its shard is tried again, for it may have been killed
    from outside. Where it ends again the trajectories that end it are looked for and rejected.

    Raises:
        InputError: One cannot be written, or cannot be made at all.
    """
    todo = list(jobs)
    tries: Counter[Job] = Counter()
    crashes: dict[Job, Crashes] = {}
    while todo:
        runs = list(spans(todo, workers))
        tasks = [_task(variant, run, crashes, out) for variant, run in runs]
        answers = carry_out(tasks, workers=workers, finished=_refuse)
        for (variant, run), answer in zip(runs, answers, strict=True):
            left = [item for item in run if _missing(variant, item, out)]
            if left:
                culprit = variant, left[0]
                tries[culprit] += 1
                if tries[culprit] == _TRIES:
                    crashes[culprit] = _crashes(*culprit, workers, carry_out)
                elif tries[culprit] > _TRIES:
                    raise InputError(_despair(*culprit, answer))
        todo = [(variant, item) for variant, item in todo if _missing(variant, item, out)]


def _task(variant: Variant, run: list[Item], crashes: dict[Job, Crashes], out: Path) -> Task:
    work = [(item, crashes.get((variant, item), {})) for item in run]
    return Task(make_shards, (variant, work, out), _SHARD_TIMEOUT * len(run))


def _refuse(_place: int, answer: Any) -> None:
    """End everything at once where a worker was refused, as by a full disk."""
    if isinstance(answer, Crash) and answer.refused:
        raise InputError(answer.reason)


def _crashes(variant: Variant, item: Item, workers: int, carry_out: Carrier) -> Crashes:
    """Find the trajectories that end the engine's process, by halving."""
    found: dict[int, str] = {}
    groups = [list(item.indices)]
    while groups:
        tasks = [
            Task(try_out, (variant, group), _TRAJECTORY_TIMEOUT * len(group)) for group in groups
        ]
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


def _halves(group: list[int]) -> tuple[list[int], list[int]]:
    middle = len(group) // 2
    return group[:middle], group[middle:]


def _missing(variant: Variant, item: Item, out: Path) -> bool:
    return not (variant.folder(out) / item.file_name).exists()


def _despair(variant: Variant, item: Item, answer: Any) -> str:
    reason = answer.reason if isinstance(answer, Crash) else "its file is not where it was put"
    return (
        f"{variant.scene.name} {variant.name}: the trajectories {item.first} to "
        f"{item.indices[-1]} cannot be made: {reason}"
    )
