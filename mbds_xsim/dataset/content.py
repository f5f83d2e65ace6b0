"""Datasets and attributes as one HDF5 file in memory, with checksums of what it means.

The bytes of a file follow from its content alone: no times, no paths, and a fixed file format. The
library never writes to disk, so that a full disk or a kill cannot leave a half-written structure.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.layout import Field, known_names
from mbds_xsim.dataset.opened import check_sources, datasets_in, opened

__all__ = [
    "CONTENT",
    "Attributes",
    "Datasets",
    "NewFile",
    "check_content",
    "encode",
    "values_of",
]

Datasets = Mapping[str, NDArray[Any]]
Attributes = Mapping[str, Any]

CONTENT = "content_sha256"
"""Attribute of a file: checksum of all its other attributes and its datasets."""
SUM = "sha256"
"""Attribute of a dataset: checksum of its type, shape and values."""
_ALIGNMENT = 64  # of datasets in a file, so that they can be mapped as arrays
_GROWTH = 2**22  # bytes by which a file in memory grows


def encode(datasets: Datasets, attributes: Attributes) -> bytes:
    """Give the bytes of the file."""
    with NewFile() as new:
        fields = known_names()
        for name in sorted(datasets):
            new.put(fields[name], datasets[name])
        return new.finished(attributes)


class NewFile:
    """An HDF5 file in memory that is being written."""

    def __init__(self) -> None:
        self.hdf5 = h5py.File(
            "new",
            "w",
            driver="core",
            backing_store=False,
            block_size=_GROWTH,
            libver=("v110", "v110"),
            alignment_threshold=_ALIGNMENT,
            alignment_interval=_ALIGNMENT,
        )
        self._told: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> NewFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.hdf5.close()

    def put(self, field: Field, values: NDArray[Any]) -> None:
        """Write a dataset, say what it is, and put its checksum."""
        told: dict[str, Any] = {}
        if field.dtype == "text":
            encoded = [str(text).encode() for text in values]
            kind = h5py.string_dtype("utf-8", max([1, *map(len, encoded)]))
            stored: NDArray[Any] = np.array(encoded, dtype=kind)
        else:
            kind, stored = np.dtype(field.dtype), np.ascontiguousarray(values, dtype=field.dtype)
        if field.dtype == "<f4":
            told["rounding"] = "to the nearest float32 of the float64 value"
            told["largest_rounding"] = _largest(stored - values)
        self.hdf5.create_dataset(field.name, data=stored, dtype=kind, track_times=False)
        self.describe(field, {**told, SUM: _sum(stored)})

    def describe(self, field: Field, more: Attributes) -> None:
        """Say on a dataset what it is."""
        told = {
            "axes": ", ".join(field.axes),
            "unit": field.unit,
            "meaning": field.meaning,
            **more,
        }
        self._told[field.name] = _plain(told)
        _put_attributes(self.hdf5[field.name], told)

    def finished(self, attributes: Attributes) -> bytes:
        """Put the attributes of the file and its checksum; give its bytes."""
        content = _digest({**self._told, "": _plain(attributes)})
        _put_attributes(self.hdf5, {**attributes, CONTENT: content})
        self.hdf5.flush()
        return bytes(self.hdf5.id.get_file_image())


def _largest(values: NDArray[Any]) -> float:
    """Largest size, of those that are numbers."""
    ends = values.min(initial=0.0), values.max(initial=0.0)
    if not np.isfinite(ends).all():
        return _largest(values[np.isfinite(values)])
    return float(max(-ends[0], ends[1]))


def _put_attributes(item: Any, attributes: Attributes) -> None:
    for key in sorted(attributes):
        item.attrs[key] = attributes[key]


def values_of(dataset: Any) -> NDArray[Any]:
    """Read a dataset whole; text as text.

    Raises:
        InputError: It is virtual, and what it reads from is not there.
    """
    check_sources(dataset)
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    return np.asarray(dataset.asstr()[()] if is_text else dataset[()])


def check_content(path: Path, names: Collection[str] | None = None) -> str | None:
    """Hold a file against its checksums; tell what differs, None where nothing does.

    Args:
        path: A data file.
        names: Only these datasets' values; all when left out.
    """
    with opened(path) as file:
        for name, dataset in datasets_in(file).items():
            told = dataset.attrs.get(SUM) if names is None or name in names else None
            if told is not None and str(told) != _sum(np.asarray(dataset[()])):
                return f"dataset {name} is not what was written"
        if str(file.attrs.get(CONTENT)) != _content_of(file):
            return "attributes are not what was written"
    return None


def _content_of(file: Any) -> str:
    found = {name: _plain(dataset.attrs) for name, dataset in datasets_in(file).items()}
    found[""] = _plain(file.attrs)
    found[""].pop(CONTENT, None)
    return _digest(found)


def _digest(attributes: Mapping[str, Attributes]) -> str:
    """Checksum of the attributes of all datasets, their checksums among them, and of the file."""
    return hashlib.sha256(json.dumps(attributes, sort_keys=True, default=repr).encode()).hexdigest()


def _sum(values: NDArray[Any]) -> str:
    if values.dtype.hasobject:
        return ""  # nothing that is written so
    found = hashlib.sha256(f"{values.dtype.str} {values.shape} ".encode())
    found.update(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
    return found.hexdigest()


def _plain(attributes: Any) -> dict[str, Any]:
    """Attributes as JSON can hold them."""
    return {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in attributes.items()
    }
