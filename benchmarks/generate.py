"""What checks and storage cost beside the engine: python -m benchmarks.generate [ENGINE…].

The raw rate is that of `simulate` alone, over the trajectories of one shard of 6pendulum; the other
that of making the whole shard: drawing, simulating, checking every trajectory, writing, reading
back, where it converges to, and its share of the audit sample's reference in a set of 15 000. Both
at matched settings, interleaved, one process on one core; the time is the core's own, so that
other processes on the machine do not count. The aim is a ratio of 0.8.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.harness import processor_s, take_turns
from mbds_xsim.dataset.gate import limit_faults, sample_findings
from mbds_xsim.dataset.shard import LOG, make_shard
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.measure.campaign import reference_of
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate

SCENE = "6pendulum"
COUNTS = {"mujoco": 217, "pybullet": 12, "dart": 6, "exudyn": 30}
REPEATS = 5
PAPER = 15_000


def audit_sample(variant: Variant) -> float:
    """Core seconds of the reference of the whole sample."""
    batch = draw_batch(variant.scene, range(3))
    contender = variant.contender
    motion = simulate(variant.scene, batch, contender.engine, contender.settings).trajectory
    return processor_s(lambda: _held(variant, batch, motion))


def _held(variant: Variant, batch: Batch, motion: Trajectory) -> None:
    truth = reference_of(variant.scene, batch, False)
    sample_findings(variant.scene, batch, motion, truth)
    limit_faults(variant.scene, variant.contender, batch, motion, truth)


def measure(engine: str, folder: Path) -> None:
    (contender,), _ = Choice.parse(engines=engine).contenders(load_scene(SCENE))
    variant = Variant(load_scene(SCENE), contender, seed=0, noise=True)
    item = Item(COUNTS[engine], COUNTS[engine])  # none of the audit sample
    batch = draw_batch(variant.scene, item.indices)
    share = audit_sample(variant) / PAPER * item.count
    works = [
        lambda: simulate(variant.scene, batch, engine, contender.settings),
        lambda: make_shard(variant, item, folder),
    ]
    raw, whole = np.median(take_turns(works, (REPEATS, REPEATS)), axis=0)
    log = (variant.folder(folder) / LOG).read_text().splitlines()
    stages = [json.loads(line) for line in log]
    parts = ", ".join(
        f"{key.removesuffix('_s')} {median(line[key] for line in stages) / item.count * 1e3:.2f}"
        for key in ("draw_s", "simulate_s", "check_s", "write_s")
    )
    alone, made = item.count / raw, item.count / (whole + share)
    print(f"{engine:9} raw {alone:7.2f}/s  made {made:7.2f}/s  ratio {made / alone:.3f}")
    print(f"{'':9} wall ms a trajectory: {parts}")


if __name__ == "__main__":
    for name in sys.argv[1:] or ["mujoco", "pybullet"]:
        with tempfile.TemporaryDirectory() as folder:
            measure(name, Path(folder))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"peak memory of this process: {peak / 1024:.0f} MiB")
