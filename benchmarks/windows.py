"""How fast random windows are read: python -m benchmarks.windows [FILE].

Without a file, 1 000 trajectories of 6pendulum are made first, in MuJoCo at its native settings.
Windows have 6 frames, of positions and of velocities, drawn at random over the whole file by one
core, 512 at a time as training does. Warm: the file is in the system's cache. Cold: it was dropped
from it before; a window then costs a read of the disk until its pages are there.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks.harness import both_s, print_table
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene

SCENE, TRAJECTORIES = "6pendulum", 1000
FRAMES, BATCH, BATCHES = 6, 512, 200
_BOTH = ("position", "velocity")
TRIES = (("cold", _BOTH), ("warm", _BOTH), ("warm", ("position",)))


def made(folder: Path) -> Path:
    """Make a data set in MuJoCo at its native settings."""
    choice = Choice.parse(engines="mujoco", profiles="native")
    (count,) = generate(Request((load_scene(SCENE),), choice, TRAJECTORIES, folder)).variants
    return folder / count.file


def drop_from_cache(files: Iterable[Path]) -> None:
    for path in files:
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)


def row(path: Path, state: str, names: tuple[str, ...]) -> list[str]:
    """Windows a second of wall time, and of this core's own time."""
    data = load_dataset(path)
    if state == "cold":
        drop_from_cache(data.files)
    windows, rng = data.windows(FRAMES, names=names), np.random.default_rng(0)

    def take() -> None:
        for _ in range(BATCHES):
            windows.take(rng.integers(len(windows), size=BATCH))

    core, wall = both_s(take)
    count = BATCH * BATCHES
    return [state, " and ".join(names), f"{count / wall:,.0f}", f"{count / core:,.0f}"]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        path = Path(sys.argv[1]) if sys.argv[1:] else made(Path(folder))
        rows = (row(path, *each) for each in TRIES)
        print_table("file|of|>windows a second|>a core second", rows)
