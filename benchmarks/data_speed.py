"""Cost of checks and storage on top of the engine, and speed of reading random windows.

    python -m benchmarks.data_speed [ENGINE…]
    python -m benchmarks.data_speed --windows [FILE]

The raw rate is that of `simulate` alone, over the trajectories of one shard of 6pendulum. The other
rate is that of making the whole shard: drawing, simulating, checking every trajectory, writing,
reading back, the convergence test, and the shard's share of the audit sample's reference in a set
of 15 000. Both run at matched settings, in turns, in one process on one core. Times are this core's
own, so that other processes on the machine do not count. The target is a ratio of 0.8.

Windows have 6 frames of positions and velocities. One core draws them at random over the whole
file, 512 at a time as in training. Without a file, 1 000 trajectories of 6pendulum are made first,
in MuJoCo at its native settings. Warm: the file is in the system's cache. Cold: it was dropped from
the cache first, so that a window costs a disk read until its pages are cached.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.harness import both_s, print_table, processor_s, take_turns
from mbds_xsim.dataset.gate import limit_faults, sample_findings
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.shard import LOG, STAGES, make_shard
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.measure.campaign import reference_of
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate

SCENE = "6pendulum"
COUNTS = {"mujoco": 217, "pybullet": 12, "dart": 6, "exudyn": 30}
REPEATS = 5
PAPER = 15_000
TRAJECTORIES, FRAMES, BATCH, BATCHES = 1000, 6, 512, 200


def making(engine: str, folder: Path) -> list[str]:
    """Return a table row: rates of simulating and making, and processor time of each stage."""
    (contender,), _ = Choice.parse(engines=engine).contenders(load_scene(SCENE))
    variant = Variant(load_scene(SCENE), contender, seed=0, noise=True)
    item = Item(variant, COUNTS[engine], COUNTS[engine])  # none from the audit sample
    batch = draw_batch(variant.scene, item.indices)
    works = [
        lambda: simulate(variant.scene, batch, engine, contender.settings),
        lambda: make_shard(item, folder),
    ]
    raw, whole = np.median(take_turns(works, (REPEATS, REPEATS)), axis=0)
    share = audit_sample(variant) / PAPER * item.count
    stages = list(map(json.loads, (variant.folder(folder) / LOG).read_text().splitlines()))
    millis = [median(line[key] for line in stages) / item.count * 1e3 for key in STAGES]
    rates = item.count / raw, item.count / (whole + share)
    figures = (*(f"{rate:.2f}" for rate in rates), f"{rates[1] / rates[0]:.3f}")
    return [engine, *figures, *(f"{value:.2f}" for value in millis)]


def audit_sample(variant: Variant) -> float:
    """Return the core time of auditing the whole sample, including its reference [s]."""
    batch = draw_batch(variant.scene, range(3))
    contender = variant.contender
    motion = simulate(variant.scene, batch, contender.engine, contender.settings).trajectory

    def audit() -> None:
        truth = reference_of(variant.scene, batch, False)
        sample_findings(variant.scene, batch, motion, truth)
        limit_faults(variant.scene, contender, batch, motion, truth)

    return processor_s(audit)


def reading(path: Path, state: str, names: tuple[str, ...]) -> list[str]:
    """Return a table row: windows per second of wall time, and of this core's own time."""
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


def drop_from_cache(files: Iterable[Path]) -> None:
    for path in files:
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)


def made(folder: Path) -> Path:
    """Make a data set in MuJoCo at its native settings."""
    choice = Choice.parse(engines="mujoco", profiles="native")
    (count,) = generate(Request((load_scene(SCENE),), choice, TRAJECTORIES, folder)).variants
    return folder / count.file


def main(words: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        if "--windows" not in words:
            stages = "|".join(f">{key.removesuffix('_s')} [ms]" for key in STAGES)
            rows = (making(name, Path(folder)) for name in words or ("mujoco", "pybullet"))
            print_table(f"engine|>raw [1/s]|>made [1/s]|>ratio|{stages}", rows)
            return
        path = Path(words[1]) if words[1:] else made(Path(folder))
        both = ("position", "velocity")
        tries = (("cold", both), ("warm", both), ("warm", ("position",)))
        print_table(
            "file|of|>windows a second|>a core second", (reading(path, *pair) for pair in tries)
        )


if __name__ == "__main__":
    main(sys.argv[1:])
