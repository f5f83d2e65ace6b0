"""Encoding of a data file as bytes in memory.

They depend on its content alone: no times, no paths, and a fixed file format. HDF5 never writes to
disk, so that a full disk or a kill cannot leave a half-written structure. It only reserves space
for the values of datasets, which are written to disk straight from their arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.hdf5 import CONTENT, ROUNDING, SUM, Attributes, bytes_of, digest, sum_of
from mbds_xsim.dataset.layout import FIELDS, Field

_ALIGNMENT = 64  # bytes, so that datasets can be mapped as arrays
_GROWTH = 2**22  # bytes by which a file in memory grows


@dataclass(frozen=True)
class Virtual:
    """Dataset whose rows are those of the same dataset in other files, one after the other."""

    like: NDArray[Any]
    """Array with the type and shape of the dataset, except for the number of rows."""
    rows: Sequence[tuple[str, int]]
    """Paths of the files, relative to the folder of this one, and the number of rows in each."""


Datasets = Mapping[str, NDArray[Any] | Virtual]


def encode(datasets: Datasets, attributes: Attributes) -> list[memoryview]:
    """Return the bytes of a file, with the layout's description of each dataset, and checksums.

    They come in pieces; those with values of datasets are views of the arrays, not copies.
    """
    descriptions: dict[str, dict[str, Any]] = {}
    values: dict[int, memoryview] = {}
    with h5py.File(
        "new",
        "w",
        driver="core",
        backing_store=False,
        block_size=_GROWTH,
        libver=("v110", "v110"),
        alignment_threshold=_ALIGNMENT,
        alignment_interval=_ALIGNMENT,
    ) as file:
        for name in sorted(datasets):
            field, dataset = FIELDS[name], datasets[name]
            file.require_group(name.rpartition("/")[0] or "/")
            about = {"axes": ", ".join(field.axes), "unit": field.unit, "meaning": field.meaning}
            if isinstance(dataset, Virtual):
                _put_virtual(file, name, dataset)
            else:
                stored, more = _stored(field, dataset)
                values |= _put(file, name, stored)
                about |= {**more, SUM: sum_of(stored)}
            descriptions[name] = about
            _put_attributes(file[name], about)
        _put_attributes(file, {**attributes, CONTENT: digest({**descriptions, "": attributes})})
        file.flush()
        return _with_values(memoryview(file.id.get_file_image()), values)


def _with_values(image: memoryview, values: Mapping[int, memoryview]) -> list[memoryview]:
    """Insert values where a file has space for them; the keys are byte offsets."""
    pieces, end = [], 0
    for offset in sorted(values):
        pieces += [image[end:offset], values[offset]]
        end = offset + len(values[offset])
    return [*pieces, image[end:]]


def _stored(field: Field, values: Any) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return values as a file stores them, and attributes that describe their rounding."""
    if field.dtype == "text":
        encoded = [str(text).encode() for text in values]
        kind = h5py.string_dtype("utf-8", max([1, *map(len, encoded)]))
        return np.array(encoded, dtype=kind), {}
    stored = np.ascontiguousarray(values, dtype=field.dtype)
    if field.dtype != "<f4":
        return stored, {}
    mode = "to the nearest float32 of the float64 value"
    return stored, {"rounding": mode, ROUNDING: _largest(stored - values)}


def _put(file: Any, name: str, stored: NDArray[Any]) -> dict[int, memoryview]:
    """Reserve space for a dataset; return its values, keyed by their byte offset in the file."""
    creation = _untimed()
    creation.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    creation.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    kind = h5py.h5t.py_create(stored.dtype, logical=True)
    space = h5py.h5s.create_simple(stored.shape)
    dataset = h5py.h5d.create(file.id, name.encode(), kind, space, dcpl=creation)
    return {dataset.get_offset(): bytes_of(stored)} if stored.size else {}


def _put_virtual(file: Any, name: str, values: Virtual) -> None:
    """Write where the rows of a dataset are; rows of a missing file read as NaN, 255 or −1."""
    inner, dtype = values.like.shape[1:], values.like.dtype
    space = h5py.h5s.create_simple((sum(count for _, count in values.rows), *inner))
    creation = _untimed()
    fill = {"f": np.nan, "u": 255, "i": -1}[dtype.kind]
    creation.set_fill_value(np.array([fill], dtype=dtype))
    first = 0
    for path, count in values.rows:
        if count:
            space.select_hyperslab((first,) + (0,) * len(inner), (count, *inner))
            source = h5py.h5s.create_simple((count, *inner))
            creation.set_virtual(space, path.encode(), name.encode(), source)
        first += count
    space.select_all()
    h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(dtype), space, dcpl=creation)


def _untimed() -> Any:
    """Return properties that create a dataset without a time stamp, unlike the default ones."""
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    creation.set_obj_track_times(False)
    return creation


def _largest(values: NDArray[Any]) -> float:
    """Return the largest absolute value of the finite numbers."""
    ends = values.min(initial=0.0), values.max(initial=0.0)
    if not np.isfinite(ends).all():
        return _largest(values[np.isfinite(values)])
    return float(max(-ends[0], ends[1]))


def _put_attributes(item: Any, attributes: Attributes) -> None:
    target = item.attrs
    for key in sorted(attributes):
        target[key] = attributes[key]
