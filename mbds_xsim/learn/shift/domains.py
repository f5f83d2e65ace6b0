"""Test domains of a scene: the same motions in every engine and variant, paired by number.

The reference is one more domain.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from mbds_xsim import reference
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.isolate import Conduct, Crash, Task, run_tasks
from mbds_xsim.dataset.hdf5 import CONTENT, attributes_of
from mbds_xsim.dataset.layout import SPLITS, split_of
from mbds_xsim.dataset.paired import STARTS, check_alike, check_paired, numbers_in
from mbds_xsim.dataset.points import Points
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.dataset.shard import ROLLOUT, stage_times
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.learn.window import HISTORY, KnownInputs, Motions, names_read
from mbds_xsim.reference.cache import directory, key_of, read_sealed, sealed
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Trajectory

REFERENCE = "reference"
"""Name of the domain that no engine made."""

_TEST = "test"
_PAIRED = (*STARTS, "input/force", "input/torque")
_TOGETHER = 8  # reference solutions per process


@dataclass(frozen=True)
class Recorded:
    """Domain of one engine in one variant: chosen test trajectories of a data file."""

    engine: str
    variant: str
    path: Path
    rows: tuple[int, ...]
    content: str
    """Checksum of the file."""

    @property
    def name(self) -> str:
        """Name of engine and variant."""
        return f"{self.engine}-{self.variant}"

    def motions(self, dtype: torch.dtype) -> Motions:
        """Read the motions."""
        rows = np.array(self.rows, dtype=np.int64)
        data = load_dataset(self.path)
        return Motions.of(data, _TEST, rows=rows, bodies=True, dtype=dtype)


@dataclass(frozen=True)
class Solved:
    """Domain of the independent reference for the same starts and inputs, as far as it is known."""

    inputs: Recorded
    """Domain that has the inputs."""
    path: Path
    """File of its `ReferenceFrames`."""
    content: str
    name: ClassVar[str] = REFERENCE
    engine: ClassVar[str] = REFERENCE
    variant: ClassVar[str] = ""
    rows: ClassVar[tuple[int, ...]] = ()

    def motions(self, dtype: torch.dtype) -> Motions:
        """Return the motions; unknown frames are NaN."""
        recorded, truth = self.inputs.motions(dtype), read_reference(self.path)
        frames = truth.position.shape[1]
        force, torque = recorded.inputs.force, recorded.inputs.torque
        return Motions(
            graph=recorded.graph,
            split=_TEST,
            index=recorded.index,
            position=recorded.graph.embed(torch.from_numpy(truth.position).to(dtype)),
            velocity=recorded.graph.embed(torch.from_numpy(truth.velocity).to(dtype), rest=0.0),
            inputs=KnownInputs(force[:, : frames - 1], torque[:, : frames - 1]),
            body=torch.from_numpy(truth.body),
        )


Domain = Recorded | Solved


@dataclass(frozen=True, eq=False)
class Paired:
    """Test trajectories of a scene that every domain has."""

    scene: Scene
    index: Index
    """Numbers of the trajectories, ascending."""
    domains: tuple[Recorded, ...]
    batch: Batch
    """Starts and inputs, the noise included; the same in all domains."""
    noise: bool
    """Whether random forces act."""
    quiet: Array
    """Forces without the noise [N], in the shape of `batch.force`."""
    seed: int
    """Seed of the draw; another seed has other starts."""
    left_out: Mapping[str, str]
    """Engines and variants without any published trajectory, with the reason."""

    @functools.cached_property
    def graph(self) -> Graph:
        """Graph of the scene."""
        return Graph.of(self.scene)


def cost_of(domain: Domain) -> float | None:
    """Return the processor time of the engine per trajectory [s]; None if unknown.

    In older logs it includes the loading of engine and model.
    """
    times = stage_times(domain.path) if isinstance(domain, Recorded) else {}
    seconds = times.get(ROLLOUT, times.get("simulate_s"))
    if seconds is None:
        return None
    return seconds / int(attributes_of(domain.path)["count"])


def scenes_in(folder: Path) -> list[str]:
    """Return the names of the scenes that a folder has data of."""
    return sorted({path.parent.name for path in folder.glob("*/*.h5") if _is_joined(path)})


def load_paired(
    folder: Path, scene: str, trajectories: int | None = None, variants: tuple[str, ...] = ()
) -> Paired:
    """Pair the test parts of all data files of a scene.

    Args:
        folder: Folder of data sets.
        scene: Name of the scene's folder in it.
        trajectories: Take at most so many, the first ones, among which the intervals take turns.
        variants: Take only files of these settings; by default all.

    Raises:
        InputError: Data are missing, damaged, or do not belong together.
    """
    place = folder / scene
    files = [load_dataset(path) for path in sorted(place.glob("*.h5")) if _is_joined(path)]
    if not files:
        msg = f"{place}: no data files; make some: mbds-xsim generate {scene} --out {folder}"
        raise InputError(msg)
    there = dict.fromkeys(file.attributes["profile"] for file in files)
    if unknown := [variant for variant in variants if variant not in there]:
        msg = f"--settings: got {unknown[0]!r}, {place} has data of {', '.join(there)} alone"
        raise InputError(f"{msg}; generate others, or leave it out")
    files = [file for file in files if not variants or file.attributes["profile"] in variants]
    check_alike(files)
    frames = int(files[0].attributes["steps"]) + 1
    if frames <= HISTORY:
        msg = f"{place}: got trajectories of {frames} frames, needed are at least {HISTORY + 1}"
        raise InputError(f"{msg}, as a model is shown {HISTORY}; generate longer ones")
    lacking = {file.variant: file.lack for file in files if file.lack}
    files = [file for file in files if not file.lack]
    if not files:
        raise InputError(f"{place}: no trajectory was published; generate other data")
    index = numbers_in(files, _TEST)
    if not len(index):
        counts = {len(numbers_in([file], _TEST)): file.variant for file in reversed(files)}
        msg = f"{place}: no test trajectory is valid in all {len(files)} files"
        least = f"{counts[min(counts)]} has fewest, {min(counts)}"
        raise InputError(f"{msg} ({least}); make more, or select others by --settings")
    for file in files:
        file.check({*_PAIRED, *names_read(file, bodies=True)})
    index = index[:trajectories]
    rows = [np.flatnonzero(np.isin(file.index, index)) for file in files]
    check_paired(files, rows, _PAIRED)
    batch, first = files[0].batch(rows[0]), files[0]
    name = "input/known_force"
    return Paired(
        scene=first.scene,
        index=index,
        domains=tuple(_recorded(*pair) for pair in zip(files, rows, strict=True)),
        batch=batch,
        noise=bool(first.attributes["noise"]),
        quiet=np.asarray(first[name][rows[0]] if name in first else np.zeros_like(batch.force)),
        seed=int(first.attributes["seed"]),
        left_out=lacking,
    )


def _is_joined(path: Path) -> bool:
    return attributes_of(path).get("kind") == "joined"


def _recorded(file: Dataset, rows: Index) -> Recorded:
    about = file.attributes
    path, chosen = file.path.resolve(), tuple(rows.tolist())
    return Recorded(about["engine"], about["profile"], path, chosen, about[CONTENT])


@dataclass(frozen=True, eq=False)
class ReferenceFrames:
    """Reference solution of a test set, up to a last frame."""

    position: Array
    """Positions of the particles [m], (trajectory, frame, particle, axis); NaN where unknown."""
    velocity: Array
    """Velocities of the particles [m/s], same shape."""
    body: Array
    """Published states of the bodies, shape (trajectory, frame, body, 13)."""
    quiet: Array
    """Positions without the noise from frame `HISTORY` on, started from this solution [m], shape
    (trajectory, frame − 6, particle, axis)."""
    growth: Array
    """Growth factor of small errors, `reference.sensitivity`, shape (trajectory, frame)."""


def solve_domain(test: Paired, horizon: int, conduct: Conduct) -> tuple[Solved | None, str]:
    """Solve the reference for all test starts; None, with the reason, if it is known nowhere."""
    batch = test.batch.truncated(HISTORY - 1 + horizon)
    path = directory() / "shift" / "truth" / f"{_key(test, batch)}.npz"
    arrays = read_sealed(path) if conduct.cache else None
    if arrays is None:
        quiet = test.quiet[:, : batch.steps]
        parts = [slice(k, k + _TOGETHER) for k in range(0, len(batch), _TOGETHER)]
        tasks = [
            Task(_solved, (test.scene, batch[part], quiet[part], conduct.cache)) for part in parts
        ]
        answers = run_tasks(tasks, workers=conduct.workers)
        crashes = [answer.reason for answer in answers if isinstance(answer, Crash)]
        if crashes:
            return None, f"the reference solution failed: {crashes[0]}"
        arrays = {
            name: np.concatenate([getattr(answer, name) for answer in answers])
            for name in ReferenceFrames.__dataclass_fields__
        }
        write_whole(path, sealed(path, arrays))
    if not np.isfinite(arrays["position"][:, HISTORY]).all(axis=(1, 2)).any():
        return None, "the reference ends at a first impact within the first frames"
    content = hashlib.sha256(path.read_bytes()).hexdigest()
    return Solved(test.domains[0], path, content), ""


def read_reference(path: Path) -> ReferenceFrames:
    """Read a solution stored by `solve_domain`, or raise InputError."""
    arrays = read_sealed(path)
    if arrays is None:
        raise InputError(f"{path}: cannot be read; run again")
    return ReferenceFrames(**arrays)


def _solved(scene: Scene, batch: Batch, quiet: Array, cache: bool) -> ReferenceFrames:
    trajectory = reference.solve(scene, batch, cache=cache)
    position, velocity = Points.of(scene).motion(trajectory)
    return ReferenceFrames(
        position=position,
        velocity=velocity,
        body=np.concatenate([getattr(trajectory, name) for name in STATES], axis=-1),
        quiet=_without_noise(scene, batch, trajectory, quiet, cache),
        growth=reference.sensitivity(scene, batch, cache=cache),
    )


def _without_noise(
    scene: Scene, batch: Batch, trajectory: Trajectory, quiet: Array, cache: bool
) -> Array:
    """Predict from the last known frame as a perfect model that does not see the noise."""
    last = HISTORY - 1
    known = np.isfinite(trajectory.position[:, last]).all(axis=(1, 2))
    states = {name: getattr(trajectory, name)[known, last] for name in STATES}
    start = Batch(
        index=batch.index[known],
        **states,
        force=quiet[known, last:],
        torque=batch.torque[known, last:],
    )
    position, _ = Points.of(scene).motion(reference.solve(scene, start, cache=cache))
    predicted = np.full((len(batch), *position.shape[1:]), np.nan)
    predicted[known] = position
    return predicted[:, 1:]


def _key(test: Paired, batch: Batch) -> str:
    digest = hashlib.sha256()
    for row in range(len(batch)):
        digest.update(key_of("shift", test.scene, batch, row, 0.0).encode())
    digest.update(np.ascontiguousarray(test.quiet[:, : batch.steps]).tobytes())
    return digest.hexdigest()


def check_data(models: Sequence[TrainedModel], test: Paired) -> None:
    """Raise InputError for models trained on other data of a domain, or on test trajectories."""
    contents = {domain.name: domain.content for domain in test.domains}
    for model in models:
        model.check_scene(test.scene)
        if model.drawn is not None and model.drawn[0] == test.seed:
            used = split_of(test.index, model.drawn[1]) != SPLITS.index("test")
            if used.any():
                raise InputError(
                    f"{model.path}: trained or validated on trajectory {test.index[used][0]} of "
                    f"the test part, as its data are {model.drawn[1]} drawn with the same seed; "
                    "test it on as many"
                )
        for engine, content in model.data:
            name = f"{engine}-{model.variant}"
            if contents.get(name, content) != content:
                raise InputError(
                    f"{model.path}: was trained on another data set {name} than the tested one; "
                    "train it on this one, or test it on its own"
                )
