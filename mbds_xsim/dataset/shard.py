"""Shards: draw, simulate and check trajectories, write published and rejected ones, join files."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import isolate
from mbds_xsim.base.files import put
from mbds_xsim.dataset.encoding import Virtual, encode
from mbds_xsim.dataset.gate import COLUMNS, TOGETHER, CheckTable, Making, judge_rows, limit_faults
from mbds_xsim.dataset.hdf5 import CONTENT, attributes_of, open_hdf5, values_of, variant_files
from mbds_xsim.dataset.layout import (
    FIELDS,
    JOINT,
    SHARED,
    SUFFIX,
    rejected_folder,
    sampled,
    split_of,
)
from mbds_xsim.dataset.points import Points
from mbds_xsim.dataset.variant import Item, Variant, folder_name
from mbds_xsim.measure.campaign import reference_of
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch, has_known_forces
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Failure, Trajectory
from mbds_xsim.simulate.readback import compare
from mbds_xsim.simulate.timed import simulate

LOG = "log.jsonl"
"""Log of the processor time of a folder's shards, one JSON object a line; no part of the data."""

STAGES = ("draw_s", "simulate_s", "check_s", "write_s")
"""Stages of making a shard, as its log names them."""

ROLLOUT = "rollout_s"
"""Part of `simulate_s` that the engine took for motions, without loading engine and model."""

Crashes = Mapping[int, str]
"""Numbers of the trajectories that end the engine's process, each with the reason."""


def make_shards(work: Mapping[Item, Crashes], out: Path, claims: Path) -> None:
    """Make, one after the other, the given shards that no other process has claimed."""
    for item, crashes in work.items():
        if claim(claims, item):
            isolate.begin()  # the time limit is for one shard
            make_shard(item, out, crashes=crashes)


def claim(claims: Path, item: Item) -> bool:
    """Claim a shard by creating a file; return False if another process was first."""
    variant = item.variant
    name = f"{folder_name(variant.scene.name)} {variant.name} {item.first}"
    try:
        (claims / name).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def make_shard(item: Item, out: Path, *, crashes: Crashes | None = None) -> None:
    """Make one shard; once its file is there, it is complete.

    Raises:
        InputError: The shard cannot be written.
    """
    watch, variant = _Watch(), item.variant
    batch = draw_batch(variant.scene, item.indices, seed=variant.seed, noise=variant.noise)
    watch.lap("draw_s")
    trajectory, misbuilt, rollout_s = _simulated(variant, batch, crashes or {})
    watch.lap("simulate_s")
    verdict = _judge(variant, batch, trajectory)
    verdict.misbuilt += misbuilt
    watch.lap("check_s")
    passed = verdict.published(certified=variant.certified)
    counts = {"published": int(passed.sum()), "rejected": int((~passed).sum())}
    attributes = {**variant.recipe, "first": item.first, "count": item.count, **counts}
    datasets = _datasets(variant, batch, trajectory, verdict)
    path = item.path(out)
    rejected_path = rejected_folder(path.parent) / path.name
    if passed.all():
        # It may be left from a shard of fewer trajectories, or from one begun before.
        rejected_path.unlink(missing_ok=True)
    else:
        reasons = np.array([verdict.reason(int(row)) for row in np.flatnonzero(~passed)])
        rejected = {**_rows(datasets, ~passed), "reason": reasons}
        put(rejected_path, *encode(rejected, {**attributes, "kind": "rejected"}))
    put(path, *encode(_rows(datasets, passed), {**attributes, "kind": "shard"}))
    watch.lap("write_s")
    times = {**watch.laps, ROLLOUT: round(rollout_s, 6)}
    _log(path.parent, {"first": item.first, "count": item.count, **counts, **times})


def try_out(variant: Variant, indices: Sequence[int]) -> None:
    """Simulate some trajectories, to see whether they end the process."""
    batch = draw_batch(variant.scene, indices, seed=variant.seed, noise=variant.noise)
    simulate(variant.scene, batch, variant.contender.engine, variant.contender.settings)


class _Watch:
    """Stopwatch for the processor time of the stages [s]."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, stage: str) -> None:
        now = time.process_time()
        self.laps[stage] = round(now - self._last, 6)
        self._last = now


def _simulated(
    variant: Variant, batch: Batch, crashes: Crashes
) -> tuple[Trajectory, list[str], float]:
    """Simulate those that do not crash; return all, model faults, and the engine's CPU time [s]."""
    contender, scene = variant.contender, variant.scene
    runs = [row for row, index in enumerate(batch.index.tolist()) if index not in crashes]
    if not runs:
        return _crashed(variant, batch, crashes), [], 0.0
    some = batch if len(runs) == len(batch) else batch[runs]
    simulation = simulate(scene, some, contender.engine, contender.settings)
    about = Mechanism.of(scene), some, contender.settings
    faults = compare(*about, simulation.readback, variant.method)
    misbuilt = [f"read-back: {line}" for line in faults]
    trajectory = simulation.trajectory
    if some is not batch:
        trajectory = _crashed(variant, batch, crashes).replaced(np.array(runs), trajectory)
    return trajectory, misbuilt, simulation.cpu_s


def _crashed(variant: Variant, batch: Batch, crashes: Crashes) -> Trajectory:
    """Return trajectories of NaN, and the failures of those that crash."""
    frames = np.asarray(variant.scene.clock.frame * np.arange(batch.steps + 1), dtype=np.float64)
    empty = Trajectory.empty(frames, len(batch), len(variant.scene.bodies))
    failures = (
        Failure(0, crashes[index]) if index in crashes else None for index in batch.index.tolist()
    )
    return dataclasses.replace(empty, failures=tuple(failures))


def _judge(variant: Variant, batch: Batch, trajectory: Trajectory) -> CheckTable:
    """Check every trajectory, and the limit of some of them as the step goes to zero."""
    scene, rows = variant.scene, sampled(batch.index)
    truth = reference_of(scene, batch[rows], False) if len(rows) else None
    verdict = judge_rows(scene, batch, trajectory, Making.of(variant.contender), truth)
    sound = ~(verdict.failed.any(axis=1) | verdict.ended)
    if not len(rows) or not sound[rows].all():  # a failed one says nothing of the others
        rows, truth = np.flatnonzero(sound)[:1], None
    if variant.certified and len(rows):
        some = (batch[rows], trajectory[rows.tolist()])
        faults = limit_faults(scene, variant.contender, *some, truth)
        verdict.misbuilt += [f"{TOGETHER}: {line}" for line in faults]
    return verdict


def _datasets(
    variant: Variant, batch: Batch, trajectory: Trajectory, verdict: CheckTable
) -> dict[str, NDArray[Any]]:
    return {
        **derived(variant.scene, batch, trajectory, variant.seed),
        "index": batch.index,
        "check/name": np.array(list(COLUMNS)),
        "check/unit": np.array(list(COLUMNS.values())),
        "check/figure": verdict.figure,
        "check/allowed": verdict.allowed,
        "check/frame": verdict.frame,
        **{f"body/{key}": getattr(trajectory, key) for key in STATES},
    }


def derived(
    scene: Scene, batch: Batch, trajectory: Trajectory, seed: int
) -> dict[str, NDArray[Any]]:
    """Return the datasets that follow from a scene, its draws, and the motion of its bodies."""
    points = Points.of(scene)
    position, velocity = points.motion(trajectory)
    datasets = {
        "interval": batch.index % len(INTERVALS),
        "time": trajectory.time,
        "position": position,
        "velocity": velocity,
        **{f"start/{key}": getattr(batch, key) for key in STATES},
        "input/force": batch.force,
        "input/torque": batch.torque,
        **points.graph(),
    }
    if has_known_forces(scene):
        known = draw_batch(scene, batch.index.tolist(), seed=seed, noise=False)
        datasets["input/known_force"] = known.force
    return datasets


def _rows(datasets: Mapping[str, NDArray[Any]], rows: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """Return some of the trajectories, with the datasets that all of them share."""
    return {
        name: values[rows] if FIELDS[name].per_trajectory and not rows.all() else values
        for name, values in datasets.items()
    }


def _log(folder: Path, facts: Mapping[str, Any]) -> None:
    line = json.dumps(facts) + "\n"
    handle = os.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        os.write(handle, line.encode())  # one call, so that lines of several workers do not mix
    finally:
        os.close(handle)


def stage_times(joined: Path) -> dict[str, float]:
    """Return the processor time over all shards of a joined file [s], by stage of their log.

    If a shard was made twice, the last time counts. The result is empty if there is no log, as of
    data fetched from elsewhere, or if it lacks a shard, as after a kill or on a full disk.
    """
    path = joined.with_suffix("") / LOG
    lines = read_log(path.read_bytes()) if path.is_file() else ()
    entries = {facts["first"]: facts for facts in lines}.values()
    if not entries or sum(facts["count"] for facts in entries) != attributes_of(joined)["count"]:
        return {}
    stages = [stage for stage in (*STAGES, ROLLOUT) if all(stage in facts for facts in entries)]
    return {stage: sum(facts[stage] for facts in entries) for stage in stages}


def read_log(text: bytes) -> Iterator[dict[str, Any]]:
    """Read the lines of a log, without those that a full disk cut off."""
    for line in text.splitlines():
        with suppress(ValueError):
            yield json.loads(line)


@dataclass(frozen=True)
class VariantCount:
    """Outcome of one variant."""

    scene: str
    variant: str
    file: str
    trajectories: int
    published: int
    rejected: int
    rejected_by: dict[str, int]
    """Numbers of rejected trajectories, keyed by the check that failed first."""
    bytes: int


def join(variants: Sequence[Variant], trajectories: int, out: Path) -> Iterator[VariantCount]:
    """Write the joined file of every variant, and the joint file of every scene."""
    for variant in variants:
        yield _join_variant(variant, trajectories, out)
    for folder in dict.fromkeys(variant.folder(out).parent for variant in variants):
        _join_scene(folder)


def _join_variant(variant: Variant, trajectories: int, out: Path) -> VariantCount:
    folder = variant.folder(out)
    shards = [Shard(item.path(out)) for item in variant.items(trajectories)]
    published = sum(len(shard.index) for shard in shards)
    facts = {
        "kind": "joined",
        "first": 0,
        "count": trajectories,
        "published": published,
        "rejected": trajectories - published,
    }
    by_check = causes(rejected_folder(folder), (shard.path for shard in shards))
    target = folder.with_name(f"{variant.name}{SUFFIX}")
    put(target, *joined(shards, trajectories, {**variant.recipe, **facts}))
    return VariantCount(
        scene=variant.scene.name,
        variant=variant.name,
        file=str(target.relative_to(out)),
        trajectories=trajectories,
        published=published,
        rejected=trajectories - published,
        rejected_by=dict(by_check.most_common()),
        bytes=sum(shard.path.stat().st_size for shard in shards),
    )


def joined(
    shards: Sequence[Shard], trajectories: int, attributes: dict[str, Any]
) -> list[memoryview]:
    """Return the bytes of a file that refers to the trajectories of all shards, without a copy."""
    index = np.concatenate([shard.index for shard in shards])
    rows = [(f"{shard.path.parent.name}/{shard.path.name}", len(shard.index)) for shard in shards]
    with open_hdf5(shards[0].path) as first:
        datasets: dict[str, NDArray[Any] | Virtual] = {
            name: Virtual(np.empty((0, *first[name].shape[1:]), first[name].dtype), rows)
            if field.per_trajectory
            else values_of(first[name])
            for name, field in FIELDS.items()
            if name in first
        }
    datasets |= {
        "index": index,
        "split": split_of(index, trajectories),
        "shard/file": np.array([name for name, _ in rows]),
        "shard/rows": np.array([count for _, count in rows]),
        "shard/content": np.array([shard.content for shard in shards]),
    }
    return encode(datasets, attributes)


class Shard:
    """Facts of a shard that are needed to join it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_hdf5(path) as file:
            self.index: NDArray[np.int64] = file["index"][()]
            self.content = str(file.attrs[CONTENT])


def causes(folder: Path, shards: Iterable[Path]) -> Counter[str]:
    """Count rejected trajectories of shards by the check that failed first."""
    counts: Counter[str] = Counter()
    for rejected in (folder / shard.name for shard in shards):
        if rejected.exists():
            with open_hdf5(rejected) as file:
                counts.update(map(cause_of, file["reason"].asstr()[()]))
    return counts


def cause_of(reason: str) -> str:
    """Return the check that failed first, or "ended early", from the text of a reason."""
    cause = re.match(rf"(?:{TOGETHER}: )?[^:]*", reason)
    return re.sub(r"^ended at frame \d+$", "ended early", cause[0] if cause else reason)


def _join_scene(folder: Path) -> None:
    """Write the joint file: which trajectories are published in all variants of a folder."""
    with open_hdf5(variant_files(folder)[0]) as file:
        shared = {key: file.attrs[key] for key in SHARED}
    datasets = joint_datasets(folder)
    count = len(datasets["valid_in_all"])
    put(folder / JOINT, *encode(datasets, {**shared, "kind": "joint", "count": count}))


def joint_datasets(folder: Path) -> dict[str, NDArray[Any]]:
    """Find which of the drawn trajectories are published in each variant, and in all variants.

    A variant in which nothing is published leaves the others paired.
    """
    paths = variant_files(folder)
    masks = [_published(path) for path in paths]
    common = min(map(len, masks))
    valid = np.stack([mask[:common] for mask in masks])
    paired = valid[[mask.any() for mask in masks]]
    return {
        "variant": np.array([path.stem for path in paths]),
        "valid": valid,
        "valid_in_all": np.asarray(paired.all(axis=0) & valid.any(axis=0)),
    }


def _published(path: Path) -> NDArray[np.bool_]:
    """Return, for each number that was drawn, whether a joined file has its trajectory."""
    with open_hdf5(path) as file:
        return np.isin(np.arange(file.attrs["count"]), file["index"][()])
