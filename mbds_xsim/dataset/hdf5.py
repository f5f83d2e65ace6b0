"""Data files as HDF5: read with suspicion, held against the layout and against their checksums.

Checksums are of what a file means. Whatever is wrong with a file is said in one line that names it.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.layout import (
    ATTRIBUTES,
    FIELDS,
    FORMAT,
    SHARED,
    UNSAID,
    VERSION,
    Field,
    attribute,
)
from mbds_xsim.dataset.points import axis_sizes
from mbds_xsim.scene.scene import Scene

_JOINT = (*SHARED, "kind", "count")
_OPTIONAL = ("input/known_force",)
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


def attributes_of(path: Path) -> dict[str, Any]:
    """Attributes of a data file.

    Raises:
        InputError: It is no data file, of a newer layout, or an attribute is missing or wrong.
    """
    with open_hdf5(path) as file:
        found = plain(file.attrs)
    if not _is(found.get("format"), FORMAT):
        msg = f"{path} is HDF5, but no {FORMAT} file: its attribute 'format' does not say so"
        raise InputError(msg)
    if not isinstance(found.get("layout_version"), int) or found["layout_version"] > VERSION:
        msg = (
            f"{path} has layout version {found.get('layout_version')}, this program reads up to "
            f"{VERSION}; install a newer mbds-xsim"
        )
        raise InputError(msg)
    wanted = [key for key in ATTRIBUTES if key in _JOINT or not _is(found.get("kind"), "joint")]
    line = f"{path}: attribute ", "; get the file again"
    given = UNSAID | found
    return found | {key: attribute(key, given, *line) for key in wanted}


def scene_of(text: Any, path: Path, advice: str = "get the file again") -> Scene:
    """Read the scene that a file has as text.

    Raises:
        InputError: It is none.
    """
    try:
        return msgspec.convert(tomllib.loads(str(text)), Scene)
    # The last are what the parser has for text that is none, numbers and brackets without end.
    except (msgspec.ValidationError, TypeError, ValueError, RecursionError) as error:
        msg = f"{path}: its attribute scene is no scene: {error}; {advice}"
        raise InputError(msg) from error


def check_fit(file: Any, path: Path, kind: str, scene: Scene | None) -> None:
    """Raise InputError where the datasets are not those of the layout and the scene."""
    wrong = next(misfits(file, kind, scene), None)
    if wrong is not None:
        msg = f"{path}: {wrong}; get it again, or generate it anew"
        raise InputError(msg)


def misfits(file: Any, kind: str, scene: Scene | None) -> Iterator[str]:
    """Say of each dataset that is not as the layout has it what is wrong with it.

    The scene decides the lengths of axes; a file without trajectories has none.
    """
    sizes = {"two": 2} if scene is None else axis_sizes(scene)
    for field in FIELDS.values():
        if kind not in field.kinds:
            continue
        dataset = file.get(field.name)
        if isinstance(dataset, h5py.Dataset) and dataset.shape is not None:
            yield from _misfit(field, dataset, sizes)
        elif dataset is not None or field.name not in _OPTIONAL:
            yield f"layout: dataset {field.name} is missing"


def _misfit(field: Field, dataset: Any, sizes: dict[str, int]) -> Iterator[str]:
    """Compare one; an axis that nothing has decided yet is as long as its first dataset's."""
    for axis, size in zip(field.axes, dataset.shape, strict=False):
        sizes.setdefault(axis, size)
    wanted = tuple(sizes.get(axis, 0) for axis in field.axes)
    if dataset.shape != wanted:
        yield f"layout: {field.name} has the shape {dataset.shape}, not {wanted}"
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    if is_text != (field.dtype == "text") or not (
        is_text or dataset.dtype == np.dtype(field.dtype)
    ):
        yield f"layout: {field.name} has the type {dataset.dtype}, not {field.dtype}"


def _is(got: Any, wanted: str) -> bool:
    return isinstance(got, str) and got == wanted


Attributes = Mapping[str, Any]

CONTENT = "content_sha256"
"""Attribute of a file: checksum of all its other attributes and its datasets."""
SUM = "sha256"
"""Attribute of a dataset: checksum of its type, shape and values."""


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

    Of datasets the values of those named are read, or of all.
    """
    with open_hdf5(path) as file:
        for name, dataset in datasets_in(file).items():
            written = dataset.attrs.get(SUM) if names is None or name in names else None
            if written is not None and str(written) != sum_of(np.asarray(dataset[()])):
                return f"dataset {name} is not what was written"
        if str(file.attrs.get(CONTENT)) != _content_of(file):
            return "attributes are not what was written"
    return None


def _content_of(file: Any) -> str:
    found = {name: dataset.attrs for name, dataset in datasets_in(file).items()}
    own = {key: value for key, value in file.attrs.items() if key != CONTENT}
    return digest({**found, "": own})


def digest(attributes: Mapping[str, Attributes]) -> str:
    """Checksum of the attributes of all datasets, their checksums among them, and of the file."""
    texts = {name: plain(each) for name, each in attributes.items()}
    return hashlib.sha256(json.dumps(texts, sort_keys=True, default=repr).encode()).hexdigest()


def sum_of(values: NDArray[Any]) -> str:
    """Checksum of an array: of its type, shape and values."""
    if values.dtype.hasobject:
        return ""  # nothing that is written so
    found = hashlib.sha256(f"{values.dtype.str} {values.shape} ".encode())
    found.update(bytes_of(values))
    return found.hexdigest()


def bytes_of(values: NDArray[Any]) -> memoryview:
    """Give the bytes of an array in the order of its last axis."""
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8).data


def plain(attributes: Any) -> dict[str, Any]:
    """Give attributes as JSON can hold them."""
    return {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in attributes.items()
    }
