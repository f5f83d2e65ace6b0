"""How fast random windows are read: python benchmarks/windows.py [FILE].

Without a file, 1 000 trajectories of 6pendulum are made first, in MuJoCo at its native settings.
Windows have 6 frames, of positions and of velocities, drawn at random over the whole file by one
core, 512 at a time as training does. Warm: the file is in the system's cache. Cold: it was dropped
from it before; a window then costs a read of the disk until its pages are there.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import mbds_xsim
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene

FRAMES = 6
BATCH = 512
BATCHES = 200


def made(folder: Path, scene: str = "6pendulum", trajectories: int = 1000) -> Path:
    """Make a data set in MuJoCo at its native settings."""
    choice = Choice.parse(engines="mujoco", profiles="native")
    request = Request((load_scene(scene),), choice, trajectories, folder)
    (count,) = generate(request).variants
    return folder / count.file


def drop_from_cache(files: Sequence[Path]) -> None:
    for path in files:
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)


def rate(data: Dataset, names: tuple[str, ...]) -> tuple[float, float]:
    """Windows per second of wall time, and of this core's own time."""
    windows = data.windows(FRAMES, names=names)
    rng = np.random.default_rng(0)
    wall, core = time.perf_counter(), time.process_time()
    for _ in range(BATCHES):
        windows.take(rng.integers(len(windows), size=BATCH))
    count = BATCH * BATCHES
    return count / (time.perf_counter() - wall), count / (time.process_time() - core)


def tell(state: str, names: tuple[str, ...], rates: tuple[float, float]) -> None:
    what = " and ".join(names)
    print(f"{state:5} {what:22} {rates[0]:10,.0f} windows/s, {rates[1]:10,.0f} per core second")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR", "/tmp")) as folder:
        path = Path(sys.argv[1]) if len(sys.argv) > 1 else made(Path(folder))
        both = ("position", "velocity")
        drop_from_cache(mbds_xsim.load_dataset(path).files)
        tell("cold", both, rate(mbds_xsim.load_dataset(path), both))
        for names in (both, ("position",)):
            rate(mbds_xsim.load_dataset(path), names)
            tell("warm", names, rate(mbds_xsim.load_dataset(path), names))
