"""Open data files: whatever is wrong with one is said in one line that names it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from mbds_xsim.errors import InputError

__all__ = ["check_sources", "datasets_in", "opened", "refuse_bomb", "refuse_other"]

_SMALL = 2**26  # bytes that any file may unpack to
_DENSEST = 100  # times that what is larger may be packed; motions come to 5 at most


@contextmanager
def opened(path: Path) -> Iterator[Any]:
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
        with opened(file) as source:
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
