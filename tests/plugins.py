"""Packages with adapters of their own, installed for a test."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from mbds_xsim.simulate import plugin, registry

__all__ = ["installed"]


@contextmanager
def installed(
    folder: Path, modules: Mapping[str, str], engines: Mapping[str, str]
) -> Iterator[None]:
    """Install a package for this process and those it starts.

    Args:
        folder: Where it is put.
        modules: Source of each of its modules.
        engines: Of each engine the place of its adapter, "module:Class".
    """
    name = folder.name.replace("-", "_")
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir(parents=True)
    for module, source in modules.items():
        (folder / f"{module}.py").write_text(source)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    points = (f"{engine} = {place}" for engine, place in engines.items())
    (metadata / "entry_points.txt").write_text("\n".join(["[mbds_xsim.adapters]", *points]))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", str(folder))
        _forget()
        try:
            yield
        finally:
            _forget()


def _forget() -> None:
    registry._points.cache_clear()
    plugin._answer.cache_clear()
