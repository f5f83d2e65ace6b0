"""Data files as HDF5: read with suspicion, written in memory, with checksums of what they mean.

Whatever is wrong with a file is said in one line that names it. The bytes of a file that is written
follow from its content alone: no times, no paths, and a fixed file format. The library never writes
to disk, so that a full disk or a kill cannot leave a half-written structure.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.layout import FIELDS, Field

_SMALL = 2**26  # bytes that any file may unpack to
_DENSEST = 100  # times that what is larger may be packed; motions come to 5 at most


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open a data file to read; all that it has is in it, but for virtual datasets.

    Raises:
        InputError: There is none, or what is read of it is truncated, damaged or something else.
    """
    refuse_other(path)
    try:
        with h5py.File(path, "r") as file:
            _check_self_contained(file, path)
            yield file
    # HDF5 gives all of these for damage, the last two for types and text that are none any more.
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        msg = f"{path} cannot be read as HDF5 ({_brief(error)}); it is truncated or something else"
        raise InputError(msg) from error


def datasets_in(file: Any) -> dict[str, Any]:
    """Give all datasets of an open file by their paths, in the order of these."""
    names: list[str] = []
    file.visit(names.append)  # nothing may be raised while the library visits
    found = {name: file[name] for name in sorted(names)}
    return {name: item for name, item in found.items() if isinstance(item, h5py.Dataset)}


def refuse_other(path: Path) -> None:
    """Refuse what is no file: a pipe would be waited for without end.

    Raises:
        InputError: There is nothing of this name, or a folder, a pipe or a device.
    """
    if path.is_file():
        return
    if path.exists():
        msg = f"{path}: this is no file but a folder, a pipe or a device; name a file"
        raise InputError(msg)
    msg = f"{path}: there is no such file"
    raise InputError(msg)


def refuse_bomb(path: Path, unpacked: int, size: int | None = None) -> None:
    """Refuse to unpack what no simulation is as dense as.

    Args:
        path: The file.
        unpacked: What it says it unpacks to [bytes].
        size: Of what it reads from [bytes]; the file itself when left out.

    Raises:
        InputError: It is many times the file.
    """
    size = path.stat().st_size if size is None else size
    if unpacked > max(_SMALL, _DENSEST * size):
        msg = (
            f"{path}: its {size / 1e6:.3g} MB say that they unpack to {unpacked / 1e6:.3g} MB, "
            f"allowed is {_DENSEST} times the size; pack it less densely if that is so"
        )
        raise InputError(msg)


def check_sources(dataset: Any) -> None:
    """Hold a virtual dataset against the files that it reads from, which HDF5 lets be missing.

    Raises:
        InputError: One is not there, or has no such dataset of its own.
    """
    if not dataset.is_virtual:
        return
    path = Path(dataset.file.filename)
    parts = {(part.file_name, part.dset_name) for part in dataset.virtual_sources()}
    files = {name: path if name == "." else path.parent / name for name, _ in parts}
    for name, file in files.items():
        if not file.is_file():
            msg = f"{path}: {dataset.name} reads from {name}, which is missing; get it again"
            raise InputError(msg)
        names = {inner for outer, inner in parts if outer == name}
        with open_hdf5(file) as source:
            if any(inner not in source or source[inner].is_virtual for inner in names):
                msg = f"{path}: {dataset.name} reads what {name} has not; get it again"
                raise InputError(msg)
    size = math.prod(dataset.shape) * dataset.dtype.itemsize
    refuse_bomb(path, size, sum(file.stat().st_size for file in files.values()))


def _check_self_contained(file: Any, path: Path) -> None:
    """Refuse links and data in other files, and more data than there can be."""
    links: list[tuple[bytes, int]] = []
    # Nothing may be raised while the library visits.
    file.id.links.visit(lambda name, link: links.append((name, link.type)), info=True)
    if any(kind == h5py.h5l.TYPE_EXTERNAL for _, kind in links):
        msg = f"{path}: holds a link to another file; put all data into one"
        raise InputError(msg)
    total = 0
    for name, kind in links:
        item = h5py.h5o.open(file.id, name) if kind == h5py.h5l.TYPE_HARD else None
        if isinstance(item, h5py.h5d.DatasetID):
            creation = item.get_create_plist()
            if creation.get_external_count():
                msg = f"{path}: {name.decode()} has its values in another file; put all into one"
                raise InputError(msg)
            if creation.get_layout() != h5py.h5d.VIRTUAL:
                total += math.prod(item.shape or ()) * item.get_type().get_size()
    refuse_bomb(path, total)


def _brief(error: Exception) -> str:
    """What the library says behind its "Unable to …", on one line."""
    whole = " ".join(str(error.args[0] if error.args else error).split())
    _, bracket, cause = whole.partition("(")
    return cause.removesuffix(")") if bracket else whole


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
        for name in sorted(datasets):
            new.put(FIELDS[name], datasets[name])
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
        self._said: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> NewFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.hdf5.close()

    def put(self, field: Field, values: NDArray[Any]) -> None:
        """Write a dataset, say what it is, and put its checksum."""
        more: dict[str, Any] = {}
        if field.dtype == "text":
            encoded = [str(text).encode() for text in values]
            kind = h5py.string_dtype("utf-8", max([1, *map(len, encoded)]))
            stored: NDArray[Any] = np.array(encoded, dtype=kind)
        else:
            kind, stored = np.dtype(field.dtype), np.ascontiguousarray(values, dtype=field.dtype)
        if field.dtype == "<f4":
            more["rounding"] = "to the nearest float32 of the float64 value"
            more["largest_rounding"] = _largest(stored - values)
        self.hdf5.create_dataset(field.name, data=stored, dtype=kind, track_times=False)
        self.describe(field, {**more, SUM: _sum(stored)})

    def describe(self, field: Field, more: Attributes) -> None:
        """Say on a dataset what it is."""
        attributes = {
            "axes": ", ".join(field.axes),
            "unit": field.unit,
            "meaning": field.meaning,
            **more,
        }
        self._said[field.name] = plain(attributes)
        _put_attributes(self.hdf5[field.name], attributes)

    def finished(self, attributes: Attributes) -> bytes:
        """Put the attributes of the file and its checksum; give its bytes."""
        content = _digest({**self._said, "": plain(attributes)})
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
    with open_hdf5(path) as file:
        for name, dataset in datasets_in(file).items():
            written = dataset.attrs.get(SUM) if names is None or name in names else None
            if written is not None and str(written) != _sum(np.asarray(dataset[()])):
                return f"dataset {name} is not what was written"
        if str(file.attrs.get(CONTENT)) != _content_of(file):
            return "attributes are not what was written"
    return None


def _content_of(file: Any) -> str:
    found = {name: plain(dataset.attrs) for name, dataset in datasets_in(file).items()}
    found[""] = plain(file.attrs)
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


def plain(attributes: Any) -> dict[str, Any]:
    """Give attributes as JSON can hold them."""
    return {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in attributes.items()
    }
