"""The reference's machine code: compiled once for a machine, before several processes need it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.reference import cache
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Inertia, Scene

_READY = "ready"
_UNUSED = 30 * 86400.0  # after which machine code of another version is removed [s]


def compile_once(notice: Callable[[str], None], *, workers: int | None) -> None:
    """Compile what the reference of a scene without contact needs, unless it is there.

    Args:
        notice: Told, before it begins, that this takes a while.
        workers: 0 where it is to be done in this process.
    """
    found = compilation(notice)
    if found is not None:
        task, then = found
        then(*run_tasks([task], workers=workers and 1))


def compilation(
    notice: Callable[[str], None],
) -> tuple[Task, Callable[[object], None]] | None:
    """Give what compiles, and what hears of its answer; None where the machine code is there."""
    if (cache.kernel_folder() / _READY).exists():
        return None
    notice("the reference is compiled for this machine, once: some 15 s of one core")

    def then(answer: object) -> None:
        if isinstance(answer, Crash):  # the work itself will meet it, and say where
            notice(f"the reference could not be compiled: {answer.reason}")

    return Task(_compile, ()), then


def _compile() -> None:
    scene = Scene(
        name="bob",
        length=1.0,
        clock=Clock(steps=1),
        bodies=(Body("bob", position=(0.5, 0.0, 0.0), inertia=Inertia(1.0, (0.1, 0.1, 0.1))),),
        distance_links=(DistanceLink("rod", ("world", "bob"), ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0))),),
    )
    solve(scene, draw_batch(scene, range(1)), cache=False)
    folder = cache.kernel_folder()
    if folder.is_dir():
        (folder / _READY).touch()
        _remove_unused(folder)


def _remove_unused(folder: Path) -> None:
    """Remove machine code of other versions that nobody has used for long."""
    for other in folder.parent.iterdir():
        if other != folder and time.time() - other.stat().st_mtime > _UNUSED:
            shutil.rmtree(other, ignore_errors=True)
