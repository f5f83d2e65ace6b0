"""Write reports/filters.md: what HDF5's chunks and filters would save of a data set, and cost.

python -m benchmarks.filters > reports/filters.md
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import mbds_xsim
from benchmarks.harness import print_head, print_made, print_table, wall_s
from benchmarks.windows import made

_SCENES = ("6pendulum", "3ladder", "balldrop")
_TRAJECTORIES = 96
_READS = 400
_WINDOW = 6  # frames
_PARTS = {
    "points, float32": ("position", "velocity"),
    "body states, float64": (
        "body/position",
        "body/orientation",
        "body/velocity",
        "body/angular_velocity",
    ),
}

_COMMAND = "python -m benchmarks.filters > reports/filters.md"
_TEXT = f"""\
What a data set would be with HDF5's filters (all with shuffle), beside no filters and no chunks, as
it is: {_TRAJECTORIES} trajectories of MuJoCo at its native settings, one core, all files in the
cache of the system. The size is a part of the numbers' own; writing is per trajectory. What is
read is drawn at random, {_READS} times, by h5py: whole trajectories, and windows of {_WINDOW}
frames, of all datasets of the row. A chunk that is read is decoded, as in a file larger than the
cache of chunks."""


@dataclass(frozen=True, slots=True)
class Way:
    """How a dataset is laid out."""

    label: str
    filters: dict[str, Any]
    chunk: int | None = None
    """Frames, None: all of a trajectory."""


_WAYS = (
    Way("none", {}),
    Way("lzf", {"compression": "lzf"}),
    Way("gzip 1", {"compression": "gzip", "compression_opts": 1}),
    Way("gzip 1, 16 frames a chunk", {"compression": "gzip", "compression_opts": 1}, 16),
    Way("gzip 4", {"compression": "gzip", "compression_opts": 4}),
)


Arrays = dict[str, NDArray[Any]]


def main() -> None:
    """Print the page."""
    print_head("Chunks and filters", _COMMAND, _TEXT)
    headings = "scene|numbers|filter|>size|>write|>read a trajectory|>read a window"
    with tempfile.TemporaryDirectory() as folder:
        print_table(headings, _rows(Path(folder)))
    print_made(f"HDF5 {h5py.version.hdf5_version}")


def _rows(folder: Path) -> Iterator[list[str]]:
    for scene in _SCENES:
        data = mbds_xsim.load_dataset(made(folder, scene, _TRAJECTORIES))
        for part, names in _PARTS.items():
            arrays = {name: np.array(data[name]) for name in names}
            for way in _WAYS:
                yield [scene, part, way.label, *_measured(arrays, way, folder / "tried.h5")]


def _measured(arrays: Arrays, way: Way, path: Path) -> list[str]:
    count = len(next(iter(arrays.values())))
    written = wall_s(lambda: _write(path, arrays, way)) / count
    with h5py.File(path, rdcc_nbytes=0) as file:
        sets = [file[name] for name in arrays]
        size = sum(data.id.get_storage_size() for data in sets)
        frames = sets[0].shape[1]
        rng = np.random.default_rng(0)
        rows = rng.integers(count, size=_READS)
        firsts = rng.integers(frames - _WINDOW + 1, size=_READS)
        whole = _each(lambda k: [data[rows[k]] for data in sets])
        window = _each(lambda k: [data[rows[k], firsts[k] : firsts[k] + _WINDOW] for data in sets])
    part = size / sum(values.nbytes for values in arrays.values())
    millis = (f"{1e3 * seconds:.2f} ms" for seconds in (written, whole))
    return [f"{part:.2f}", *millis, f"{1e6 * window:.0f} µs"]


def _write(path: Path, arrays: Arrays, way: Way) -> None:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            chunk = (1, way.chunk or values.shape[1], *values.shape[2:])
            layout = {"chunks": chunk, "shuffle": True} | way.filters if way.filters else {}
            file.create_dataset(name, data=values, **layout)


def _each(read: Callable[[int], object]) -> float:
    """Mean time of one read [s]."""
    return wall_s(lambda: [read(k) for k in range(_READS)]) / _READS


if __name__ == "__main__":
    main()
