"""Machine code: compiled once for a machine, before several processes need it."""

from __future__ import annotations

import gc
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.reference import cache
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Inertia, Scene

_UNUSED = 30 * 86400.0  # after which machine code of another version is removed [s]


@dataclass(frozen=True)
class Kernels:
    """Functions that are compiled together."""

    name: str
    """Of what they belong to."""
    use: Callable[[], None]
    """Calls each of them, which compiles it."""
    seconds: int
    """About so long that takes one core."""

    @property
    def marker(self) -> Path:
        """A file that is there once they are compiled."""
        return cache.kernel_folder() / f"{self.name} ready"


def _solve_once() -> None:
    scene = Scene(
        name="bob",
        length=1.0,
        clock=Clock(steps=1),
        bodies=(Body("bob", position=(0.5, 0.0, 0.0), inertia=Inertia(1.0, (0.1, 0.1, 0.1))),),
        distance_links=(DistanceLink("rod", ("world", "bob"), ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0))),),
    )
    solve(scene, draw_batch(scene, range(1)), cache=False)


REFERENCE = Kernels("reference", _solve_once, 10)
"""What the reference of a scene without contact needs."""


def compile_once(
    notice: Callable[[str], None],
    *,
    workers: int | None,
    kernels: Sequence[Kernels] = (REFERENCE,),
) -> None:
    """Compile kernels that are not yet, each in a process of its own.

    Args:
        notice: Told, before it begins, that this takes a while.
        workers: Processes at a time; 0 where it is to be done in this one.
        kernels: Which.
    """
    found = [each for each in (compilation(notice, some) for some in kernels) if each is not None]
    answers = run_tasks([task for task, _ in found], workers=workers)
    for (_, then), answer in zip(found, answers, strict=True):
        then(answer)


def compilation(
    notice: Callable[[str], None], kernels: Kernels = REFERENCE
) -> tuple[Task, Callable[[object], None]] | None:
    """Give what compiles, and what hears of its answer; None where the machine code is there."""
    if kernels.marker.exists():
        return None
    whose = f"the machine code of the {kernels.name}"
    notice(f"{whose} is compiled for this machine, once: some {kernels.seconds} s of one core")

    def then(answer: object) -> None:
        if isinstance(answer, Crash):  # the work itself will meet it, and say where
            notice(f"{whose} could not be compiled: {answer.reason}")

    return Task(_compile, (kernels,)), then


def _compile(kernels: Kernels) -> None:
    gc.disable()  # looking for garbage takes a tenth of the time
    try:
        kernels.use()
    finally:
        gc.enable()
    folder = cache.kernel_folder()
    if folder.is_dir():
        kernels.marker.touch()
        _remove_unused(folder)


def _remove_unused(folder: Path) -> None:
    """Remove machine code of other versions that nobody has used for long."""
    for other in folder.parent.iterdir():
        with suppress(FileNotFoundError):  # another process removes it, too
            if other != folder and time.time() - other.stat().st_mtime > _UNUSED:
                shutil.rmtree(other, ignore_errors=True)
