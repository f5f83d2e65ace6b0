"""Write a data file again in other layouts of HDF5, as its tools do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

__all__ = ["ELSEWHERE", "LAYOUTS", "OTHER_TYPES", "Layout", "repack"]

Layout = Callable[[Any, str, Any, Path], None]
"""Function that writes a dataset into a file: (file, name, old dataset, old file)."""

_COMPACT = 60_000  # bytes that an object's header may hold


def _create(**options: Any) -> Layout:
    def put(file: Any, name: str, old: Any, _source: Path) -> None:
        chunked = options if old.size and old.ndim else {}
        file.create_dataset(name, data=old[()], dtype=old.dtype, **chunked)

    return put


def _growing(file: Any, name: str, old: Any, _source: Path) -> None:
    limit = {"maxshape": (None,) * old.ndim} if old.size else {}
    file.create_dataset(name, data=old[()], dtype=old.dtype, **limit)


def _compact(file: Any, name: str, old: Any, _source: Path) -> None:
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    if old.nbytes < _COMPACT:
        creation.set_layout(h5py.h5d.COMPACT)
    file.require_group(name.rpartition("/")[0] or "/")
    kind, space = old.id.get_type(), old.id.get_space()
    made = h5py.h5d.create(file.id, name.encode(), kind, space, dcpl=creation)
    if old.size:
        made.write(h5py.h5s.ALL, h5py.h5s.ALL, old[()])


def _external(file: Any, name: str, old: Any, source: Path) -> None:
    if old.dtype.kind != "f" or not old.size:
        _create()(file, name, old, source)
        return
    values = source.with_name(f"{name.replace('/', '-')}.bin")
    values.write_bytes(old[()].tobytes())
    place = [(str(values), 0, old.nbytes)]
    file.create_dataset(name, old.shape, old.dtype, external=place)


def _virtual(file: Any, name: str, old: Any, source: Path) -> None:
    if not old.size:
        _create()(file, name, old, source)
        return
    layout = h5py.VirtualLayout(old.shape, old.dtype)
    layout[...] = h5py.VirtualSource(str(source), name, old.shape)
    file.create_virtual_dataset(name, layout)


def _linked(file: Any, name: str, old: Any, source: Path) -> None:
    if old.dtype.kind == "f":
        file[name] = h5py.ExternalLink(str(source), name)
    else:
        _create()(file, name, old, source)


def _cast(change: Callable[[np.dtype[Any]], np.dtype[Any]]) -> Layout:
    def put(file: Any, name: str, old: Any, source: Path) -> None:
        if old.dtype.kind != "f":
            _create()(file, name, old, source)
        else:
            with np.errstate(invalid="ignore"):
                file.create_dataset(name, data=old[()].astype(change(old.dtype)))

    return put


LAYOUTS: dict[str, Layout] = {
    "contiguous": _create(),
    "chunks": _create(chunks=True),
    "gzip": _create(chunks=True, compression="gzip"),
    "shuffle": _create(chunks=True, shuffle=True, compression="lzf"),
    "checksums": _create(chunks=True, fletcher32=True),
    "growing": _growing,
    "compact": _compact,
    "virtual": _virtual,
}
"""Layouts that are read correctly."""

ELSEWHERE: dict[str, Layout] = {"external": _external, "linked": _linked}
"""Layouts with values in another file, which checksums and copies miss."""

OTHER_TYPES: dict[str, Layout] = {
    "big-endian": _cast(lambda dtype: dtype.newbyteorder(">")),
    "half": _cast(lambda _: np.dtype("<f2")),
    "integers": _cast(lambda _: np.dtype("<i8")),
}


def repack(source: Path, target: Path, layout: Layout, *, userblock: int = 0) -> None:
    """Write a file again, with all its attributes."""
    with h5py.File(source) as old, h5py.File(target, "w", userblock_size=userblock) as new:
        new.attrs.update(old.attrs)

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                layout(new, name, item, source)
                if isinstance(new.get(name, getlink=True), h5py.HardLink):
                    new[name].attrs.update(item.attrs)

        old.visititems(visit)
