"""Make data sets: one variant an engine and scene, in shards, then joined."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import frame_of
from mbds_xsim.base.isolate import core_count, run_tasks
from mbds_xsim.base.silence import Silent
from mbds_xsim.dataset.card import write_card
from mbds_xsim.dataset.files import locked, tidied
from mbds_xsim.dataset.join import VariantCount, join
from mbds_xsim.dataset.layout import rejected_folder
from mbds_xsim.dataset.variant import Item, Variant, check_same_draws, folder_name, pending
from mbds_xsim.dataset.work import Carrier, ShardProgress, make, watched
from mbds_xsim.measure.quick import searched
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.timed import Work, forewarnings


@dataclass(frozen=True)
class Request:
    """What is asked for."""

    scenes: tuple[Scene, ...]
    choice: Choice
    trajectories: int
    out: Path
    seed: int = 0
    noise: bool = True


@dataclass(frozen=True)
class Generated:
    """What came of a request."""

    variants: tuple[VariantCount, ...]
    left_out: dict[str, str]
    """Scenes and engines that do not go together, with the reason."""
    failed: dict[str, str]
    """Variants that were begun but cannot be made, with the reason; the others are whole."""
    made: int
    """Trajectories that this run made; an earlier one may have made others."""
    wall_s: float

    def to_frame(self) -> Any:
        """Give a `pandas.DataFrame` with a row for each data set."""
        return frame_of(self.variants)


def generate(
    request: Request,
    *,
    workers: int | None = None,
    progress: ShardProgress | None = None,
    carry_out: Carrier = run_tasks,
) -> Generated:
    """Make what is missing of the data asked for; run again after any interruption to go on.

    Raises:
        InputError: Nothing can be made as asked, or the folder holds or gets something else.
    """
    begin, progress = time.perf_counter(), progress or Silent()
    if request.trajectories < 1:
        msg = f"--trajectories: got {request.trajectories}, allowed is 1 or more"
        raise InputError(msg)
    variants, left_out = _variants(request, workers, progress)
    for scene in {variant.scene.name: variant.scene for variant in variants}.values():
        _check_drawn(scene, request)
    out = request.out.absolute()  # workers stand elsewhere
    with locked(request.out):
        for variant in variants:
            check_same_draws(variant, request.out)
        todo = {
            variant: pending(variant, request.trajectories, request.out) for variant in variants
        }
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
        with tidied(written), watched(folders, progress):
            processes = core_count() if workers is None else workers
            every = [item for items in todo.values() for item in items]
            failures = make(every, out, workers=processes, carry_out=carry_out)
        failed = {f"{v.scene.name} {v.name}": reason for v, reason in failures.items()}
        whole = [variant for variant in variants if variant not in failures]
        if not whole:
            raise InputError("; ".join(f"{name}: {reason}" for name, reason in failed.items()))
        counts = tuple(join(whole, request.trajectories, request.out))
        for folder in dict.fromkeys(variant.folder(request.out).parent for variant in whole):
            write_card(folder)
    return Generated(counts, left_out, failed, missing, time.perf_counter() - begin)


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
        choice = searched(scene, request.choice, workers=workers, progress=_Found(progress))
        contenders, reasons = choice.contenders(scene)
        variants += [Variant(scene, one, request.seed, request.noise) for one in contenders]
        left_out |= {f"{scene.name} {engine}": reason for engine, reason in reasons.items()}
    return variants, left_out


class _Found:
    """Tells of settings that are found as of trajectories that are made."""

    def __init__(self, progress: ShardProgress) -> None:
        self._progress = progress

    def begin(self, total: int) -> None:
        self._progress.begin(total, 0)

    def advance(self, what: str) -> None:
        del what
        self._progress.advance(1, 0)


def _forewarnings(items: list[Item], workers: int | None) -> list[str]:
    """Announce what will take minutes, from a few steps of the engine."""
    count, variant = sum(item.count for item in items), items[0].variant
    scene, contender = variant.scene, variant.contender
    steps = count * scene.clock.duration / contender.settings.step
    work = Work(contender.name, contender.engine, contender.settings, steps)
    start = draw_batch(scene, [0], seed=variant.seed, noise=variant.noise)
    return forewarnings(scene, start, [work], workers=workers)


def _check_drawn(scene: Scene, request: Request) -> None:
    """Refuse a scene whose trajectories are copies: no part of such a set could test another."""
    count = min(request.trajectories, len(INTERVALS) + 1)  # the last is of the first's interval
    drawn = draw_batch(scene, range(count), seed=request.seed, noise=request.noise)
    first: dict[bytes, int] = {}
    for row in range(count):
        one = drawn[row : row + 1]
        values = (one.position, one.orientation, one.velocity, one.angular_velocity)
        same = first.setdefault(
            b"".join(v.tobytes() for v in (*values, one.force, one.torque)), row
        )
        if same != row:
            msg = (
                f"{scene.name}: trajectories {same} and {row} would be the same, as nothing of "
                "them is drawn; give the scene [[sampling]] or noise, or ask for --trajectories "
                f"{row}"
            )
            raise InputError(msg)
