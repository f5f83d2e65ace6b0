"""Have shards made by processes, also by engines that crash theirs, and tell of their progress."""

from __future__ import annotations

import json
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from mbds_xsim.base.isolate import Crash, Task
from mbds_xsim.dataset.shard import LOG, Crashes, claim, make_shards, try_out
from mbds_xsim.dataset.variant import Item, Variant

_TRAJECTORY_TIMEOUT = 600.0  # [s]
_TRIES = 2
_FEW = 5


class Carrier(Protocol):
    """What carries tasks out: `mbds_xsim.base.isolate.run_tasks`, or a cluster."""

    def __call__(
        self,
        tasks: Sequence[Task],
        *,
        workers: int | None = None,
        finished: Callable[[int, Any], None] | None = None,
    ) -> list[Any]:
        """Give one answer a task, or a `Crash`; in the order of the tasks."""


def make(
    items: Sequence[Item], out: Path, *, workers: int, carry_out: Carrier
) -> dict[Variant, str]:
    """Make shards; those that are there when this ends abnormally are complete.

    Each process makes shards of one variant, the next that no other has claimed. Where one ends
    without an answer the shard is tried again, for it may have been killed from outside. Where
    that ends again the trajectories that end it are looked for and rejected.

    Returns:
        Of variants that cannot be made, why: a shard that cannot be written, or an engine that
        refuses the scene or always ends its process. The others are whole.
    """
    todo = list(items)
    tries: Counter[Item] = Counter()
    crashes: dict[Item, Crashes] = {}
    failed: dict[Variant, str] = {}
    idle = 0  # rounds in which processes ended before they came to anything
    while todo:
        ended: dict[Variant, list[Crash]] = {item.variant: [] for item in todo}
        with _claims(out) as claims:
            tasks = list(_tasks(todo, crashes, out, claims, workers))
            answers = carry_out([task for _, task in tasks], workers=workers)
            for (variant, _), answer in zip(tasks, answers, strict=True):
                if isinstance(answer, Crash):
                    ended[variant].append(answer)
                    if answer.refused:
                        failed.setdefault(variant, answer.reason)
            left = [
                item for item in todo if item.variant not in failed and not item.path(out).exists()
            ]
            guilty = [item for item in left if not claim(claims, item)]
        idle = 0 if guilty or len(left) < len(todo) else idle + 1
        if idle > _TRIES:
            failed[left[0].variant] = _despair(left[0], ended)
        for item in guilty:
            tries[item] += 1
            if tries[item] == _TRIES:
                crashes[item] = _crashes(item, workers, carry_out)
            elif tries[item] > _TRIES:
                failed.setdefault(item.variant, _despair(item, ended))
        todo = [item for item in left if item.variant not in failed]
    return failed


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
    todo: Sequence[Item], crashes: dict[Item, Crashes], out: Path, claims: Path, workers: int
) -> Iterator[tuple[Variant, Task]]:
    for variant in dict.fromkeys(item.variant for item in todo):
        work = {item: crashes.get(item, {}) for item in todo if item.variant is variant}
        task = Task(make_shards, (work, out, claims), variant.contender.limit)
        yield from [(variant, task)] * max(1, min(workers, len(work)))


def _crashes(item: Item, workers: int, carry_out: Carrier) -> Crashes:
    """Find the trajectories that end the engine's process, by halving.

    Where each of a few from all over the shard does, none of the others is tried.
    """
    variant, most = item.variant, item.variant.contender.limit

    def tried(groups: list[list[int]]) -> list[tuple[list[int], str]]:
        tasks = [
            Task(try_out, (variant, g), min(_TRAJECTORY_TIMEOUT * len(g), most)) for g in groups
        ]
        answers = zip(groups, carry_out(tasks, workers=workers), strict=True)
        return [(group, one.reason) for group, one in answers if isinstance(one, Crash)]

    few = [[item.indices[k * (item.count - 1) // (_FEW - 1)]] for k in range(_FEW)]
    guilty = tried(few) if item.count > _FEW else []
    if len(guilty) == _FEW:
        others = f"not tried, as each of {_FEW} others of its shard ended: {guilty[0][1]}"
        return dict.fromkeys(item.indices, others) | {group[0]: why for group, why in guilty}
    found: dict[int, str] = {}
    groups = [list(item.indices)]
    while groups:
        guilty = tried(groups)
        found |= {group[0]: reason for group, reason in guilty if len(group) == 1}
        larger = [group for group, _ in guilty if len(group) > 1]
        halves = ((group[: len(group) // 2], group[len(group) // 2 :]) for group in larger)
        groups = [half for pair in halves for half in pair]
    return found


def _despair(item: Item, ended: dict[Variant, list[Crash]]) -> str:
    reasons = [crash.reason for crash in ended[item.variant]]
    reason = reasons[0] if reasons else "its file is not where it was put"
    return f"the trajectories {item.first} to {item.indices[-1]} cannot be made: {reason}"


_INTERVAL = 0.3  # [s]


class ShardProgress(Protocol):
    """Where progress is told."""

    def begin(self, total: int, done: int) -> None:
        """Say how many trajectories there are, and how many an earlier run has made."""

    def advance(self, done: int, rejected: int) -> None:
        """Count trajectories that were made since, and how many of them were rejected."""

    def notice(self, line: str) -> None:
        """Say what is to stay and be read."""


@contextmanager
def watched(folders: Sequence[Path], progress: ShardProgress) -> Iterator[None]:
    """Tell what is added to the logs of some folders while the block runs."""
    logs = [folder / LOG for folder in folders]
    places = {path: path.stat().st_size if path.exists() else 0 for path in logs}

    def look() -> None:
        facts = [line for path in places for line in _added(path, places)]
        if facts:
            done = sum(line["count"] for line in facts)
            progress.advance(done, sum(line["rejected"] for line in facts))

    try:
        with repeating(look):
            yield
    finally:
        look()


def _added(path: Path, places: dict[Path, int]) -> list[dict[str, int]]:
    """Read the lines of a log that were added since, and note the place up to which it is read."""
    if not path.exists():
        return []
    with path.open("rb") as file:
        file.seek(places[path])
        text = file.read()
    whole = text[: text.rfind(b"\n") + 1]
    places[path] += len(whole)
    return [json.loads(line) for line in whole.splitlines()]


@contextmanager
def repeating(look: Callable[[], None]) -> Iterator[None]:
    """Look again and again while the block runs."""
    ended = threading.Event()

    def go_on() -> None:
        while not ended.wait(_INTERVAL):
            look()

    thread = threading.Thread(target=go_on, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
