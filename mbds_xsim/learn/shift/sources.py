"""The code that something depends on, as a checksum."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

__all__ = ["sources"]

_FOLLOWED = (
    "mbds_xsim.assembly",
    "mbds_xsim.dataset.points",
    "mbds_xsim.joint_space",
    "mbds_xsim.learn",
    "mbds_xsim.markers",
    "mbds_xsim.mechanism",
    "mbds_xsim.rotation",
    "mbds_xsim.sampling",
    "mbds_xsim.simulate",
    "mbds_xsim.spin",
    "mbds_xsim.state",
)
"""What figures follow from; all else only reads, writes and runs."""


def sources(*modules: str) -> bytes:
    """Hash the source of modules and of all of `_FOLLOWED` that they import."""
    found: dict[str, bytes] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name] = _path(name).read_bytes()
            waiting += _imported(found[name])
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(name.encode() + found[name])
    return digest.digest()


def _path(module: str) -> Path:
    found = importlib.util.find_spec(module)
    assert found is not None
    assert found.origin is not None
    return Path(found.origin)


def _imported(source: bytes) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            # What is imported from a package may be a module of it.
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            yield from filter(_is_followed, names)


def _is_followed(name: str) -> bool:
    parts = name.split(".")
    within = {".".join(parts[:k]) for k in range(1, len(parts) + 1)}
    return bool(within & {*_FOLLOWED}) and _is_module(name)


def _is_module(name: str) -> bool:
    parent = importlib.util.find_spec(name.rpartition(".")[0])
    if parent is None or parent.submodule_search_locations is None:
        return False
    return importlib.util.find_spec(name) is not None
