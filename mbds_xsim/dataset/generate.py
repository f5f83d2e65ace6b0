"""Generation of data sets: one variant for each scene, engine and setting, in shards, then joined.

Shards are made in processes of their own, so that an engine that crashes does no further harm.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import locked, tidied
from mbds_xsim.base.frame import frame_of
from mbds_xsim.base.isolate import Carrier, Conduct, Crash, Meter, Silent, Task, run_tasks
from mbds_xsim.checks.kernels import CHECKS
from mbds_xsim.dataset.card import write_card
from mbds_xsim.dataset.layout import rejected_folder
from mbds_xsim.dataset.shard import (
    LOG,
    Crashes,
    VariantCount,
    claim,
    join,
    make_shards,
    read_log,
    try_out,
)
from mbds_xsim.dataset.variant import (
    Item,
    Variant,
    check_same_draws,
    folder_name,
    pending,
    unpaired,
)
from mbds_xsim.measure.quick import searched
from mbds_xsim.reference.kernels import REFERENCE, compile_once
from mbds_xsim.scene.reach import doubted_length
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.timed import Work, forewarnings

_TRAJECTORY_TIMEOUT = 600.0  # [s]
_TRIES = 2
_FEW = 5
_INTERVAL = 0.3  # time between two readings of the logs [s]
_LARGEST_SEED = 2**63 - 1
_MOST = 1_000_000_000  # trajectories; to list the shards of many more takes hours and much memory


@dataclass(frozen=True)
class Request:
    """Request for data sets."""

    scenes: tuple[Scene, ...]
    choice: Choice
    trajectories: int
    out: Path
    seed: int = 0
    noise: bool = True


@dataclass(frozen=True)
class Generated:
    """Outcome of a request."""

    variants: tuple[VariantCount, ...]
    left_out: dict[str, str]
    """Pairs of scene and engine that do not go together, each with the reason."""
    failed: dict[str, str]
    """Variants that were begun but cannot be made, with the reason; all others are complete."""
    made: int
    """Number of trajectories that this run made; an earlier one may have made others."""
    wall_s: float

    def to_frame(self) -> Any:
        """Return a `pandas.DataFrame` with one row per data set."""
        return frame_of(self.variants)


class ShardProgress(Meter, Protocol):
    """Receiver of progress reports: on settings found, then on trajectories made."""

    def begin(self, total: int, done: int = 0) -> None:
        """Report the total number, and the number that an earlier run has made."""

    def made(self, done: int, rejected: int) -> None:
        """Count newly made trajectories, and those of them that were rejected."""


def generate(
    request: Request,
    *,
    workers: int | None = None,
    progress: ShardProgress | None = None,
    carry_out: Carrier = run_tasks,
) -> Generated:
    """Make the requested data that are missing; after an interruption, run again to continue.

    Raises:
        InputError: Nothing can be made as asked, or the folder holds other data or is in use.
    """
    begin, progress = time.perf_counter(), progress or Silent()
    if not 1 <= request.trajectories <= _MOST:
        raise InputError(f"--trajectories: got {request.trajectories}, allowed is 1 to {_MOST}")
    if request.seed > _LARGEST_SEED:
        msg = f"--seed: got {request.seed}, allowed is 0 to {_LARGEST_SEED}, which a file can store"
        raise InputError(msg)
    if not all(scene.contacts for scene in request.scenes):
        compile_once(progress.notice, workers=workers, kernels=[REFERENCE, CHECKS])
    variants, left_out = _variants(request, workers, progress)
    for scene in {variant.scene.name: variant.scene for variant in variants}.values():
        _check_drawn(scene, request, progress)
    out = request.out.absolute()  # workers have another current folder
    with locked(request.out):
        for variant in variants:
            check_same_draws(variant, request.out)
        todo = {
            variant: pending(variant, request.trajectories, request.out) for variant in variants
        }
        for line in unpaired(variants, request.trajectories, request.out):
            progress.notice(line)
        missing = sum(item.count for items in todo.values() for item in items)
        total = request.trajectories * len(variants)
        for items in filter(None, todo.values()):
            for line in _forewarnings(items, workers):
                progress.notice(line)
        progress.begin(total, total - missing)
        folders = [variant.folder(out) for variant in variants]
        written = {folder.parent for folder in folders}.union(
            folders, map(rejected_folder, folders)
        )
        with tidied(written), _watched(folders, progress):
            every = [item for items in todo.values() for item in items]
            failures = _make(every, out, workers=Conduct(workers).processes, carry_out=carry_out)
        failed = {f"{v.scene.name} {v.name}": reason for v, reason in failures.items()}
        complete = [variant for variant in variants if variant not in failures]
        if not complete:
            raise InputError("; ".join(f"{name}: {reason}" for name, reason in failed.items()))
        for variant in complete if missing else ():
            pending(variant, request.trajectories, request.out)  # refuses those of other workers
        counts = tuple(join(complete, request.trajectories, request.out))
        for folder in dict.fromkeys(variant.folder(request.out).parent for variant in complete):
            write_card(folder)
    made = sum(item.count for variant in complete for item in todo[variant])
    return Generated(counts, left_out, failed, made, time.perf_counter() - begin)


def _variants(
    request: Request, workers: int | None, progress: ShardProgress
) -> tuple[list[Variant], dict[str, str]]:
    names = [folder_name(scene.name) for scene in request.scenes]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        msg = f"two scenes would both be stored as {twice[0]!r}; rename one, or generate it apart"
        raise InputError(msg)
    variants: list[Variant] = []
    left_out: dict[str, str] = {}
    for scene in request.scenes:
        choice = searched(scene, request.choice, Conduct(workers, meter=progress))
        contenders, reasons = choice.contenders(scene)
        variants += [Variant(scene, one, request.seed, request.noise) for one in contenders]
        left_out |= {f"{scene.name} {engine}": reason for engine, reason in reasons.items()}
    return variants, left_out


def _forewarnings(items: list[Item], workers: int | None) -> list[str]:
    """Return warnings of work that will take minutes, judged by a few steps of the engine."""
    count, variant = sum(item.count for item in items), items[0].variant
    scene, contender = variant.scene, variant.contender
    steps = count * scene.clock.duration / contender.settings.step
    work = Work(contender.name, contender.engine, contender.settings, steps)
    start = draw_batch(scene, [0], seed=variant.seed, noise=variant.noise)
    return forewarnings(scene, start, [work], workers=workers)


def _check_drawn(scene: Scene, request: Request, progress: ShardProgress) -> None:
    """Refuse a scene whose trajectories are copies: no part of such a set could test another.

    Warn of one so far from the origin that float32 cannot hold the positions of its particles,
    and of a length in what seems another unit.
    """
    if doubt := doubted_length(scene):
        progress.notice(doubt)
    count = min(request.trajectories, len(INTERVALS) + 1)  # the last shares the first's interval
    drawn = draw_batch(scene, range(count), seed=request.seed, noise=request.noise)
    first: dict[bytes, int] = {}
    for row in range(count):
        values = (getattr(drawn, key)[row] for key in (*STATES, "force", "torque"))
        earlier = first.setdefault(b"".join(each.tobytes() for each in values), row)
        if earlier != row:
            raise InputError(
                f"{scene.name}: trajectories {earlier} and {row} would be the same, as nothing "
                "in the scene is random; give the scene [[sampling]] or noise, or ask for "
                f"--trajectories {row}"
            )
    far = np.float32(np.abs(drawn.position).max())
    if (rounding := float(np.spacing(far)) / 2) > scene.budget.gap:
        progress.notice(
            f"{scene.name}: {far:.1g} m from the origin float32 rounds positions of particles by "
            f"{rounding:.1g} m; use the states of bodies, or describe the scene nearer to it"
        )


def _make(
    items: Sequence[Item], out: Path, *, workers: int, carry_out: Carrier
) -> dict[Variant, str]:
    """Make shards; those that are in place after an abnormal end are complete.

    Each process makes shards of one variant, always the next that no other process has claimed. If
    it ends without an answer, its shard is tried again, as it may have been killed from outside. If
    it ends again, the trajectories that end it are found and rejected.

    Returns:
        Reasons why variants cannot be made: a shard cannot be written, or the engine refuses the
        scene or always ends its process. All other variants are complete.
    """
    todo = list(items)
    tries: Counter[Item] = Counter()
    crashes: dict[Item, Crashes] = {}
    failed: dict[Variant, str] = {}
    idle = 0  # rounds in which processes ended without any progress
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
            remaining = [
                item for item in todo if item.variant not in failed and not item.path(out).exists()
            ]
            guilty = [item for item in remaining if not claim(claims, item)]
        idle = 0 if guilty or len(remaining) < len(todo) else idle + 1
        if idle > _TRIES:
            failed[remaining[0].variant] = _despair(remaining[0], ended)
        for item in guilty:
            tries[item] += 1
            if tries[item] == _TRIES:
                crashes[item] = _crashes(item, workers, carry_out)
            elif tries[item] > _TRIES:
                failed.setdefault(item.variant, _despair(item, ended))
        todo = [item for item in remaining if item.variant not in failed]
    return failed


@contextmanager
def _claims(out: Path) -> Iterator[Path]:
    """Provide an empty folder in which processes claim shards."""
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
    """Find the trajectories that end the engine's process, by bisection.

    If each of a few from all over the shard does so, the others count as well, without a trial.
    """
    variant, most = item.variant, item.variant.contender.limit

    def try_groups(groups: list[list[int]]) -> list[tuple[list[int], str]]:
        tasks = [
            Task(try_out, (variant, g), min(_TRAJECTORY_TIMEOUT * len(g), most)) for g in groups
        ]
        answers = zip(groups, carry_out(tasks, workers=workers), strict=True)
        return [(group, answer.reason) for group, answer in answers if isinstance(answer, Crash)]

    few = [[item.indices[k * (item.count - 1) // (_FEW - 1)]] for k in range(_FEW)]
    guilty = try_groups(few) if item.count > _FEW else []
    if len(guilty) == _FEW:
        untried = f"not tried, as {_FEW} others of its shard all failed: {guilty[0][1]}"
        return dict.fromkeys(item.indices, untried) | {group[0]: why for group, why in guilty}
    reasons: dict[int, str] = {}
    groups = [list(item.indices)]
    while groups:
        guilty = try_groups(groups)
        reasons |= {group[0]: reason for group, reason in guilty if len(group) == 1}
        larger = [group for group, _ in guilty if len(group) > 1]
        halves = ((group[: len(group) // 2], group[len(group) // 2 :]) for group in larger)
        groups = [half for pair in halves for half in pair]
    return reasons


def _despair(item: Item, ended: dict[Variant, list[Crash]]) -> str:
    reasons = [crash.reason for crash in ended[item.variant]]
    reason = reasons[0] if reasons else "its file is not where it was put"
    return f"the trajectories {item.first} to {item.indices[-1]} cannot be made: {reason}"


@contextmanager
def _watched(folders: Sequence[Path], progress: ShardProgress) -> Iterator[None]:
    """Report the lines added to the logs of some folders while the block runs."""
    logs = [folder / LOG for folder in folders]
    places = {path: path.stat().st_size if path.exists() else 0 for path in logs}

    def look() -> None:
        facts = [line for path in places for line in _added(path, places)]
        if facts:
            done = sum(line["count"] for line in facts)
            progress.made(done, sum(line["rejected"] for line in facts))

    try:
        with repeating(look):
            yield
    finally:
        look()


def _added(path: Path, places: dict[Path, int]) -> list[dict[str, Any]]:
    """Read the lines added to a log since the last call, and note how far it has been read."""
    if not path.exists():
        return []
    with path.open("rb") as file:
        file.seek(places[path])
        text = file.read()
    whole = text[: text.rfind(b"\n") + 1]
    places[path] += len(whole)
    return [*read_log(whole)]


@contextmanager
def repeating(look: Callable[[], None]) -> Iterator[None]:
    """Call `look` at regular intervals while the block runs."""
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
