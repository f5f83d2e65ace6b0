"""Machine code that is compiled once for a machine, before several processes need it."""

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
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene

_UNUSED = 30 * 86400.0  # time unused after which other versions' machine code is removed [s]


@dataclass(frozen=True)
class Kernels:
    """Functions that are compiled together."""

    name: str
    """Name of the part of the program that they belong to."""
    use: Callable[[], None]
    """Function that calls each of them, which compiles it."""
    seconds: int
    """Approximate time that this takes one core."""

    @property
    def marker(self) -> Path:
        """File that exists once they are compiled."""
        return cache.kernel_folder() / f"{self.name} ready"


BOB = Scene(
    name="bob",
    length=1.0,
    clock=Clock(steps=10),
    bodies=(Body("bob", position=(0.0, 0.0, -0.5), inertia=Inertia(1.0, (0.1, 0.1, 0.1))),),
    joints=(Joint("nail", "ball", "world", "bob", (0.0, 0.0, 0.0)),),
)
"""Body that hangs still on a ball joint."""


def _solve_once() -> None:
    solve(BOB, draw_batch(BOB, range(1)), cache=False)


REFERENCE = Kernels("reference", _solve_once, 10)
"""Kernels that the reference needs for a scene without contact."""


def compile_once(
    notice: Callable[[str], None], *, workers: int | None, kernels: Sequence[Kernels] = (REFERENCE,)
) -> None:
    """Compile the kernels that are not compiled yet, each in a process of its own.

    Args:
        notice: Called with a line to show: that this takes a while, or that it failed.
        workers: Number of processes at a time; 0 compiles in this one.
        kernels: Kernels to compile.
    """
    jobs = [each for each in (compilation(notice, some) for some in kernels) if each is not None]
    answers = run_tasks([task for task, _ in jobs], workers=workers)
    for (_, then), answer in zip(jobs, answers, strict=True):
        then(answer)


def compilation(
    notice: Callable[[str], None], kernels: Kernels = REFERENCE
) -> tuple[Task, Callable[[object], None]] | None:
    """Return a task that compiles and a function for its answer; None if already compiled."""
    if kernels.marker.exists():
        return None
    subject = f"the machine code of the {kernels.name}"
    notice(f"{subject} is compiled for this machine, once: about {kernels.seconds} s on one core")

    def then(answer: object) -> None:
        if isinstance(answer, Crash):  # the work itself will fail, and report where
            notice(f"{subject} could not be compiled: {answer.reason}")

    return Task(_compile, (kernels,)), then


def _compile(kernels: Kernels) -> None:
    gc.disable()  # garbage collection takes a tenth of the time
    try:
        kernels.use()
    finally:
        gc.enable()
    folder = cache.kernel_folder()
    if folder.is_dir():
        kernels.marker.touch()
        _remove_unused(folder)


def _remove_unused(folder: Path) -> None:
    """Remove machine code of other versions that has not been used for long."""
    for other in folder.parent.iterdir():
        with suppress(FileNotFoundError):  # another process may remove it, too
            if other != folder and time.time() - other.stat().st_mtime > _UNUSED:
                shutil.rmtree(other, ignore_errors=True)
