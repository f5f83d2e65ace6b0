"""Datasets and attributes as one HDF5 file in memory, with checksums of what it means.

The bytes of a file follow from its content alone: no times, no paths, and a fixed file format. The
library never writes to disk, so that a full disk or a kill cannot leave a half-written structure.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.layout import Field, known_names

__all__ = [
    "CONTENT",
    "Attributes",
    "Datasets",
    "check_content",
    "describe",
    "digest",
    "encode",
    "finished",
    "open_new",
    "put_field",
    "values_of",
]

Datasets = Mapping[str, NDArray[Any]]
Attributes = Mapping[str, Any]

CONTENT = "content_sha256"
"""Attribute of a file: checksum of all its other attributes and its datasets."""
SUM = "sha256"
"""Attribute of a dataset: checksum of its type, shape and values."""
_ALIGNMENT = 64  # of datasets in a file, so that they can be mapped as arrays


def encode(datasets: Datasets, attributes: Attributes) -> bytes:
    """Give the bytes of the file."""
    with open_new("content") as file:
        fields = known_names()
        for name in sorted(datasets):
            put_field(file, fields[name], datasets[name])
        return finished(file, attributes)


def open_new(name: str) -> Any:
    """Open a new HDF5 file in memory."""
    return h5py.File(
        name,
        "w",
        driver="core",
        backing_store=False,
        libver=("v110", "v110"),
        alignment_threshold=_ALIGNMENT,
        alignment_interval=_ALIGNMENT,
        track_order=False,
    )


def finished(file: Any, attributes: Attributes) -> bytes:
    """Put the attributes of the file and its checksum; give its bytes."""
    for key in sorted(attributes):
        file.attrs[key] = attributes[key]
    file.attrs[CONTENT] = digest(file)
    file.flush()
    return bytes(file.id.get_file_image())


def values_of(dataset: Any) -> NDArray[Any]:
    """Read a dataset whole; text as text."""
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    return np.asarray(dataset.asstr()[()] if is_text else dataset[()])


def check_content(path: Path) -> str | None:
    """Hold a file against its checksums; tell what differs, None where nothing does."""
    with h5py.File(path, "r") as file:
        for name, dataset in _datasets(file):
            if SUM in dataset.attrs and dataset.attrs[SUM] != _sum(dataset[()]):
                return f"dataset {name} is not what was written"
        if file.attrs.get(CONTENT) != digest(file):
            return "attributes are not what was written"
    return None


def digest(file: Any) -> str:
    """Checksum of all attributes and, by their own checksums, of all datasets."""
    found = {"": _plain(file.attrs)}
    for name, dataset in _datasets(file):
        found[name] = _plain(dataset.attrs)
    found[""].pop(CONTENT, None)
    return hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()


def describe(dataset: Any, field: Field) -> None:
    """Say on a dataset what it is."""
    dataset.attrs["axes"] = ", ".join(field.axes)
    dataset.attrs["unit"] = field.unit
    dataset.attrs["meaning"] = field.meaning


def put_field(file: Any, field: Field, values: NDArray[Any]) -> None:
    """Write a dataset, say what it is, and put its checksum."""
    if field.dtype == "text":
        encoded = [str(text).encode() for text in values]
        kind = h5py.string_dtype("utf-8", max([1, *map(len, encoded)]))
        stored: NDArray[Any] = np.array(encoded, dtype=kind)
    else:
        kind, stored = np.dtype(field.dtype), np.ascontiguousarray(values, dtype=field.dtype)
    dataset = file.create_dataset(field.name, data=stored, dtype=kind, track_times=False)
    describe(dataset, field)
    if field.dtype == "<f4":
        off = np.abs(stored - values).max(initial=0.0, where=np.isfinite(values))
        dataset.attrs["rounding"] = "to the nearest float32 of the float64 value"
        dataset.attrs["largest_rounding"] = float(off)
    dataset.attrs[SUM] = _sum(stored)


def _sum(values: NDArray[Any]) -> str:
    found = hashlib.sha256(f"{values.dtype.str} {values.shape} ".encode())
    found.update(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
    return found.hexdigest()


def _datasets(file: Any) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            found.append((name, item))

    file.visititems(visit)
    return sorted(found, key=lambda pair: pair[0])


def _plain(attributes: Any) -> dict[str, Any]:
    """Attributes as JSON can hold them."""
    return {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in attributes.items()
    }
