"""Test domains of a scene: the same motions in every engine and variant, paired by their number."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from mbds_xsim.dataset.content import CONTENT
from mbds_xsim.dataset.facts import attributes_of
from mbds_xsim.dataset.paired import STARTS, STATES, check_alike, check_paired, numbers_in
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.window import Inputs, Motions, names_read
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch

__all__ = ["REFERENCE", "Domain", "Paired", "Recorded", "Solved", "load_paired", "scenes_in"]

Array = NDArray[np.float64]

REFERENCE = "reference"
"""Name of the domain that no engine made."""

_TEST = "test"
_PAIRED = (*STARTS, "input/force", "input/torque")


@dataclass(frozen=True)
class Recorded:
    """What one engine made in one variant: chosen test trajectories of a data file."""

    engine: str
    variant: str
    path: Path
    rows: tuple[int, ...]
    content: str
    """Checksum of the file."""

    @property
    def name(self) -> str:
        """Engine and variant."""
        return f"{self.engine}-{self.variant}"

    def motions(self, dtype: torch.dtype) -> Motions:
        """Read them."""
        rows = np.array(self.rows, dtype=np.int64)
        data = load_dataset(self.path)
        return Motions.of(data, _TEST, rows=rows, bodies=True, dtype=dtype)


@dataclass(frozen=True)
class Solved:
    """The independent reference for the same starts and inputs; unknown after a first impact."""

    inputs: Recorded
    """A domain that has the inputs."""
    path: Path
    """Where `truth.Truth` is kept."""
    content: str
    name: ClassVar[str] = REFERENCE
    engine: ClassVar[str] = REFERENCE
    variant: ClassVar[str] = ""

    def motions(self, dtype: torch.dtype) -> Motions:
        """Give the motions; frames that are not known are not numbers."""
        from mbds_xsim.learn.shift.truth import read_truth

        told, truth = self.inputs.motions(dtype), read_truth(self.path)
        frames = truth.position.shape[1]
        return Motions(
            graph=told.graph,
            split=_TEST,
            index=told.index,
            position=told.graph.embed(torch.from_numpy(truth.position).to(dtype)),
            velocity=told.graph.embed(torch.from_numpy(truth.velocity).to(dtype), rest=0.0),
            inputs=Inputs(told.inputs.force[:, : frames - 1], told.inputs.torque[:, : frames - 1]),
            body=torch.from_numpy(truth.body),
        )


Domain = Recorded | Solved


@dataclass(frozen=True, eq=False)
class Paired:
    """Test trajectories of a scene that every domain has."""

    scene: Scene
    index: NDArray[np.int64]
    """Their numbers, ascending."""
    domains: tuple[Recorded, ...]
    batch: Batch
    """Starts and inputs, the noise included; the same in all domains."""
    noise: bool
    """Whether random forces act."""
    quiet: Array
    """Forces without the noise [N], of the shape of `batch.force`."""
    seed: int
    """Of the draw: another one has other starts."""
    left_out: Mapping[str, str]
    """Engines and variants of whose trajectories none were published, with the reason."""

    @functools.cached_property
    def graph(self) -> Graph:
        """Of the scene."""
        return Graph.of(self.scene)


def scenes_in(folder: Path) -> list[str]:
    """Names of the scenes that a folder has data of."""
    return sorted({path.parent.name for path in folder.glob("*/*.h5") if _is_joined(path)})


def load_paired(
    folder: Path, scene: str, trajectories: int | None = None, variants: tuple[str, ...] = ()
) -> Paired:
    """Pair the test parts of all data files of a scene.

    Args:
        folder: Of data sets.
        scene: Name of the scene's folder in it.
        trajectories: Take at most so many, the first ones: the intervals take turns.
        variants: Only files of these settings; left out, all.

    Raises:
        InputError: There is no data, or it is not what was written, or files do not belong
            together: another scene, seed, length or start, or no test trajectory that all have.
    """
    paths = sorted(path for path in (folder / scene).glob("*.h5") if _is_joined(path))
    if not paths:
        msg = (
            f"{folder / scene}: no data files; make some: mbds-xsim generate {scene} --out {folder}"
        )
        raise InputError(msg)
    files = [load_dataset(path) for path in paths]
    files = [file for file in files if not variants or file.attributes["profile"] in variants]
    if not files:
        msg = f"{folder / scene}: no data of {', '.join(variants)} settings; generate some"
        raise InputError(msg)
    check_alike(files)
    lacking = {_name(file): file.lack for file in files if file.lack}
    files = [file for file in files if not file.lack]
    if not files:
        msg = f"{folder / scene}: no trajectory was published; generate other data"
        raise InputError(msg)
    index = numbers_in(files, _TEST)
    if not len(index):
        msg = f"{folder / scene}: no test trajectory is valid in all {len(files)} files; make more"
        raise InputError(msg)
    for file in files:
        file.check({*_PAIRED, *names_read(bodies=True)})
    index = index[:trajectories]
    rows = [np.flatnonzero(np.isin(file.index, index)) for file in files]
    check_paired(files, rows, _PAIRED)
    return Paired(
        scene=files[0].scene,
        index=index,
        domains=tuple(_recorded(*pair) for pair in zip(files, rows, strict=True)),
        batch=_batch(files[0], rows[0]),
        noise=bool(files[0].attributes["noise"]),
        quiet=_quiet(files[0], rows[0]),
        seed=int(files[0].attributes["seed"]),
        left_out=lacking,
    )


def _name(file: Dataset) -> str:
    return f"{file.attributes['engine']}-{file.attributes['profile']}"


def _is_joined(path: Path) -> bool:
    return attributes_of(path).get("kind") == "joined"


def _recorded(file: Dataset, rows: NDArray[np.int64]) -> Recorded:
    told = file.attributes
    return Recorded(
        engine=told["engine"],
        variant=told["profile"],
        path=file.path.resolve(),
        rows=tuple(rows.tolist()),
        content=told[CONTENT],
    )


def _batch(file: Dataset, rows: NDArray[np.int64]) -> Batch:
    states = {name: _stacked(file, f"start/{name}", rows) for name in STATES}
    inputs = {name: _stacked(file, f"input/{name}", rows) for name in ("force", "torque")}
    return Batch(index=file.index[rows], **states, **inputs)


def _quiet(file: Dataset, rows: NDArray[np.int64]) -> Array:
    if "input/known_force" in file:
        return _stacked(file, "input/known_force", rows)
    return np.zeros_like(_stacked(file, "input/force", rows))


def _stacked(file: Dataset, name: str, rows: NDArray[np.int64]) -> NDArray[Any]:
    return np.asarray(file[name][rows])
