"""HDF5 data files: read with suspicion, checked against the layout and against their checksums.

Checksums cover the content of a file, not its bytes. Each fault is one line that names the file.
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
    ATTRIBUTE_DEFAULTS,
    ATTRIBUTES,
    FIELDS,
    FORMAT,
    SHARED,
    SUFFIX,
    VERSION,
    Field,
    attribute,
)
from mbds_xsim.dataset.points import axis_sizes
from mbds_xsim.scene.scene import Scene

_JOINT = (*SHARED, "kind", "count")
_OPTIONAL = ("input/known_force",)
_SMALL = 2**26  # bytes that any file may unpack to
_DENSEST = 100  # largest compression factor of larger files; motions reach 5 at most


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open a data file for reading; only its virtual datasets may refer to other files.

    Raises:
        InputError: There is no such file, or it is truncated, damaged or something else.
    """
    refuse_other(path)
    try:
        with h5py.File(path, "r") as file:
            _check_self_contained(file, path)
            yield file
    except InputError:  # about what is in the file; that of a scene is a ValueError, too
        raise
    # HDF5 raises all of these for damage, the last two for damaged types and text.
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        msg = f"{path} cannot be read as HDF5 ({_brief(error)}); it is truncated or something else"
        raise InputError(msg) from error


def datasets_in(file: Any) -> dict[str, Any]:
    """Return all datasets of an open file, keyed and sorted by their paths."""
    names: list[str] = []
    file.visit(names.append)  # nothing may be raised while the library visits
    items = {name: file[name] for name in sorted(names)}
    return {name: item for name, item in items.items() if isinstance(item, h5py.Dataset)}


def refuse_other(path: Path) -> None:
    """Refuse anything but a regular file: reading a pipe could wait forever.

    Raises:
        InputError: Nothing has this name, or it is a folder, a pipe or a device.
    """
    if path.is_file():
        return
    if path.exists():
        raise InputError(f"{path}: this is no file but a folder, a pipe or a device; name a file")
    raise InputError(f"{path}: there is no such file")


def refuse_bomb(path: Path, unpacked: int, size: int | None = None) -> None:
    """Refuse to unpack data that are packed more densely than those of any simulation.

    Args:
        path: The file.
        unpacked: Size to which the file claims to unpack [bytes].
        size: Size of the files that it reads from [bytes]; that of the file itself if None.

    Raises:
        InputError: The unpacked size is many times the packed one.
    """
    size = path.stat().st_size if size is None else size
    if unpacked > max(_SMALL, _DENSEST * size):
        raise InputError(
            f"{path}: its {size / 1e6:.3g} MB claim to unpack to {unpacked / 1e6:.3g} MB, "
            f"allowed is {_DENSEST} times the size; compress it less if that is true"
        )


def check_sources(dataset: Any) -> None:
    """Check that the sources of a virtual dataset exist: HDF5 itself tolerates missing ones.

    Raises:
        InputError: A file is missing, has no such dataset of its own, or unpacks to too much.
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
                msg = f"{path}: {dataset.name} reads data that {name} lacks; get it again"
                raise InputError(msg)
    size = math.prod(dataset.shape) * dataset.dtype.itemsize
    refuse_bomb(path, size, sum(file.stat().st_size for file in files.values()))


def _check_self_contained(file: Any, path: Path) -> None:
    """Refuse links to other files, data in other files, and more data than there can be."""
    links: list[tuple[bytes, int]] = []
    # Nothing may be raised while the library visits.
    file.id.links.visit(lambda name, link: links.append((name, link.type)), info=True)
    if any(kind == h5py.h5l.TYPE_EXTERNAL for _, kind in links):
        raise InputError(f"{path}: holds a link to another file; put all data into one")
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
    """Return the cause in an error of the library, without its "Unable to …", on one line."""
    whole = " ".join(str(error.args[0] if error.args else error).split())
    _, bracket, cause = whole.partition("(")
    return cause.removesuffix(")") if bracket else whole


def attributes_of(path: Path) -> dict[str, Any]:
    """Return the attributes of a data file.

    Raises:
        InputError: It is not a data file, has a newer layout, or an attribute is missing or wrong.
    """
    with open_hdf5(path) as file:
        attrs = plain(file.attrs)
    if not _is(attrs.get("format"), FORMAT):
        msg = f"{path} is HDF5, but no {FORMAT} file: its attribute 'format' does not say so"
        raise InputError(msg)
    context = f"{path}: attribute ", "; get the file again"
    version = attribute("layout_version", attrs, *context)
    if version > VERSION:
        msg = f"{path} has layout version {version}, this program reads up to {VERSION}; install"
        raise InputError(f"{msg} a newer mbds-xsim")
    required = [key for key in ATTRIBUTES if key in _JOINT or not _is(attrs.get("kind"), "joint")]
    with_defaults = ATTRIBUTE_DEFAULTS | attrs
    return attrs | {key: attribute(key, with_defaults, *context) for key in required}


def variant_files(folder: Path, *, below: bool = False) -> list[Path]:
    """Return the joined files of all variants in a folder, without files of other programs.

    A file next to a folder of its name counts even if it does not look like a joined file: it is
    damaged, which must not pass in silence.

    Args:
        folder: Folder of a scene, or any other.
        below: Whether to search the folders in it, too.
    """
    pattern = f"*-*{SUFFIX}"  # engine and settings; shards are named by a number
    paths = sorted(folder.rglob(pattern) if below else folder.glob(pattern))
    return [path for path in paths if path.with_suffix("").is_dir() or _is_joined(path)]


def _is_joined(path: Path) -> bool:
    try:
        with open_hdf5(path) as file:
            attrs = plain(file.attrs)
    except InputError:
        return False
    return _is(attrs.get("format"), FORMAT) and _is(attrs.get("kind"), "joined")


def scene_of(text: Any, path: Path, advice: str = "get the file again") -> Scene:
    """Parse the scene that a file holds as text.

    Raises:
        InputError: The text is not a scene.
    """
    try:
        return msgspec.convert(tomllib.loads(str(text)), Scene)
    # The parser raises the last two for invalid text, huge numbers and deep nesting.
    except (msgspec.ValidationError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: its attribute scene is no scene: {error}; {advice}") from error


def check_fit(file: Any, path: Path, kind: str, scene: Scene | None) -> None:
    """Raise InputError unless the datasets are those of the layout and the scene."""
    fault = next(misfits(file, kind, scene), None)
    if fault is not None:
        raise InputError(f"{path}: {fault}; get it again, or generate it anew")


def misfits(file: Any, kind: str, scene: Scene | None) -> Iterator[str]:
    """Yield the faults of datasets that differ from the layout.

    The scene decides the lengths of axes; it is None for a file without trajectories.
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
    """Compare one dataset; the first one with an axis of undecided length decides the length."""
    for axis, size in zip(field.axes, dataset.shape, strict=False):
        sizes.setdefault(axis, size)
    shape = tuple(sizes.get(axis, 0) for axis in field.axes)
    if dataset.shape != shape:
        yield f"layout: {field.name} has the shape {dataset.shape}, not {shape}"
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    if is_text != (field.dtype == "text") or not (
        is_text or dataset.dtype == np.dtype(field.dtype)
    ):
        yield f"layout: {field.name} has the type {dataset.dtype}, not {field.dtype}"


def _is(value: Any, expected: str) -> bool:
    return isinstance(value, str) and value == expected


Attributes = Mapping[str, Any]

CONTENT = "content_sha256"
"""Attribute of a file: checksum of all its other attributes and its datasets."""
SUM = "sha256"
"""Attribute of a dataset: checksum of its type, shape and values."""
ROUNDING = "largest_rounding"
"""Attribute of a dataset in float32: largest difference from the float64 values."""


def values_of(dataset: Any) -> NDArray[Any]:
    """Read a whole dataset; text is returned as `str`.

    Raises:
        InputError: The dataset is virtual, and a file that it reads from is missing.
    """
    check_sources(dataset)
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    return np.asarray(dataset.asstr()[()] if is_text else dataset[()])


def check_content(path: Path, names: Collection[str] | None = None) -> str | None:
    """Compare a file with its checksums; return the first difference, or None if there is none.

    Only the values of the datasets in `names` are read, or of all if it is None.
    """
    with open_hdf5(path) as file:
        sets = datasets_in(file)
        for name, dataset in sets.items():
            checksum = dataset.attrs.get(SUM) if names is None or name in names else None
            if checksum is not None and str(checksum) != sum_of(np.asarray(dataset[()])):
                return f"dataset {name} is not what was written"
        own = {key: value for key, value in file.attrs.items() if key != CONTENT}
        content = digest({name: dataset.attrs for name, dataset in sets.items()} | {"": own})
        if str(file.attrs.get(CONTENT)) != content:
            return "attributes are not what was written"
    return None


def digest(attributes: Mapping[str, Attributes]) -> str:
    """Return a checksum of the attributes of all datasets, checksums included, and of the file."""
    texts = {name: plain(each) for name, each in attributes.items()}
    return hashlib.sha256(json.dumps(texts, sort_keys=True, default=repr).encode()).hexdigest()


def sum_of(values: NDArray[Any]) -> str:
    """Return a checksum of an array's type, shape and values."""
    if values.dtype.hasobject:
        return ""  # such arrays are never written
    checksum = hashlib.sha256(f"{values.dtype.str} {values.shape} ".encode())
    checksum.update(bytes_of(values))
    return checksum.hexdigest()


def bytes_of(values: NDArray[Any]) -> memoryview:
    """Return the bytes of an array in C order."""
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8).data


def plain(attributes: Any) -> dict[str, Any]:
    """Return attributes as values that JSON can hold."""
    return {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in attributes.items()
    }
