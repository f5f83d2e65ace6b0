"""Cost estimates for data sets of any size, measured on a few of their trajectories."""

from __future__ import annotations

import json
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Conduct, Crash, Task, run_tasks
from mbds_xsim.dataset.layout import AUDIT_EVERY, AUDITED, rejected_folder
from mbds_xsim.dataset.shard import LOG, STAGES, make_shard
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.measure.quick import searched
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice

_JOINED_BYTES = 9  # index and split of a trajectory in the joined file
_HOUR = 3600.0
_MOST = 10**15  # trajectories planned; figures of endless numbers would overflow


@dataclass(frozen=True)
class ShardCost:
    """Measured cost of a few trajectories, made as `generate` makes them."""

    sample: int
    """Number of trajectories in a measured shard."""
    published: int
    """Number of published trajectories in the two measured shards."""
    start_s: float
    """Processor time that the first shard of a process adds, to load the engine [s]."""
    shard_s: float
    """Processor time of a shard without trajectories [s]."""
    trajectory_s: float
    """Processor time that each trajectory adds [s]."""
    spread: float
    """Difference between the times of the two measured shards, relative to their mean."""
    shares: dict[str, float]
    """Shares of the processor time by stage: drawing, simulating, checking and writing."""
    shard_bytes: float
    """Size of a shard without trajectories."""
    trajectory_bytes: float
    """Size that each trajectory adds."""
    audit_s: float | None
    """Processor time of comparing with the reference the audit sample of each 15 000 trajectories
    [s]; None if not measured here."""


@dataclass(frozen=True)
class Estimate:
    """Estimated cost of one variant."""

    variant: str
    method: str
    step_s: float
    measured: ShardCost | None
    failure: str
    """Reason why nothing could be measured; empty otherwise."""
    shards: int
    core_hours: float | None
    wall_hours: float | None
    """Wall time with the requested number of processes."""
    bytes: float | None


@dataclass(frozen=True)
class CostPlan:
    """Estimated cost of a data set."""

    scene: str
    trajectories: int
    workers: int
    estimates: tuple[Estimate, ...]
    left_out: dict[str, str]


def plan(
    scene: Scene, choice: Choice, trajectories: int, conduct: Conduct, *, sample: int = 6
) -> CostPlan:
    """Measure a few trajectories of each engine, one engine at a time, and estimate the total cost.

    Args:
        scene: Scene to simulate.
        choice: Engines and their settings.
        trajectories: Number of trajectories planned.
        conduct: Options of the work, with the number of processes that will make the data.
        sample: Number of trajectories in a measured shard.

    Raises:
        InputError: The engines cannot simulate the scene, or the number is out of range.
    """
    if not 1 <= trajectories <= _MOST:
        msg = f"--trajectories: got {trajectories!r:.60}, allowed is 1 to {_MOST}"
        raise InputError(msg)
    choice = searched(scene, choice, conduct)
    contenders, left_out = choice.contenders(scene)
    variants = [Variant(scene, contender, seed=0, noise=True) for contender in contenders]
    meter = conduct.meter
    meter.begin(len(variants))
    # The reference is the same for all engines, so its cost is measured once.
    tasks = [
        Task(measure, (one, sample, one is variants[0]), one.contender.limit) for one in variants
    ]
    answers = run_tasks(
        tasks, workers=1, finished=lambda place, _: meter.advance(variants[place].name)
    )
    audit_s = next((a.audit_s for a in answers if isinstance(a, ShardCost) and a.audit_s), 0.0)
    estimates = [
        estimate(variant, answer, trajectories, audit_s=audit_s, workers=conduct.processes)
        for variant, answer in zip(variants, answers, strict=True)
    ]
    return CostPlan(scene.name, trajectories, conduct.processes, tuple(estimates), left_out)


def estimate(
    variant: Variant, answer: ShardCost | Crash, trajectories: int, *, audit_s: float, workers: int
) -> Estimate:
    """Extrapolate the measured cost, taking each shard and each trajectory to cost the same."""
    shards = variant.shard_count(trajectories)
    about = variant.name, variant.method.name, variant.contender.settings.step
    if isinstance(answer, Crash):
        return Estimate(*about, None, answer.reason, shards, None, None, None)
    audits, processes = math.ceil(trajectories / AUDIT_EVERY), min(workers, shards)
    seconds = shards * answer.shard_s + trajectories * answer.trajectory_s + audits * audit_s
    hours = (seconds + processes * answer.start_s) / _HOUR
    size = shards * answer.shard_bytes
    size += trajectories * (answer.trajectory_bytes + _JOINED_BYTES)
    return Estimate(*about, answer, "", shards, hours, hours / processes, size)


def measure(variant: Variant, sample: int, audit: bool) -> ShardCost:
    """Measure a shard of one trajectory and two of several, after one that loads everything.

    Their trajectories are not in the audit sample, whose cost is measured separately.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, first = Path(folder), AUDITED
        cold = _make(Item(variant, first, 1), out / "cold")
        one = _make(Item(variant, first, 1), out / "one")
        items = [Item(variant, first + k * sample, sample) for k in range(2)]
        runs = [_make(item, out / f"many{item.first}") for item in items]
        seconds, sizes = ([float(run[key]) for run in runs] for key in ("seconds", "bytes"))
        mean, more = float(np.mean(seconds)), max(sample - 1, 1)
        trajectory_s = max(mean - one["seconds"], 0.0) / more
        trajectory_s = min(trajectory_s or mean / sample, mean / sample)
        shard_s = max(mean - sample * trajectory_s, 0.0)
        trajectory_bytes = (float(np.mean(sizes)) - one["bytes"]) / more
        audit_s = None
        if audit:
            audited = _make(Item(variant, 0, AUDITED), out / "audit")
            audit_s = max(audited["seconds"] - shard_s - AUDITED * trajectory_s, 0.0)
    total = sum(run[stage] for run in runs for stage in STAGES) or 1.0
    return ShardCost(
        sample=sample,
        published=sum(run["published"] for run in runs),
        start_s=max(cold["seconds"] - one["seconds"], 0.0),
        shard_s=shard_s,
        trajectory_s=trajectory_s,
        spread=abs(seconds[0] - seconds[1]) / mean,
        shares={stage: sum(run[stage] for run in runs) / total for stage in STAGES},
        shard_bytes=max(one["bytes"] - trajectory_bytes, 0.0),
        trajectory_bytes=trajectory_bytes,
        audit_s=audit_s,
    )


def _make(item: Item, out: Path) -> dict[str, Any]:
    """Make a shard; return its processor time, its bytes, and the facts in its log."""
    begin = time.process_time()
    make_shard(item, out)
    seconds = time.process_time() - begin
    folder = item.path(out).parent
    files = [*folder.glob("*.h5"), *rejected_folder(folder).glob("*.h5")]
    size = sum(file.stat().st_size for file in files)
    facts: dict[str, Any] = json.loads((folder / LOG).read_text("utf-8"))
    return {**facts, "seconds": seconds, "bytes": size}
