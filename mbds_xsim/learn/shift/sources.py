"""The code that something depends on, as a checksum."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

__all__ = ["sources"]

_PACKAGE = "mbds_xsim.learn"


def sources(*modules: str) -> bytes:
    """Hash the source of modules and of all that they import from `mbds_xsim.learn`."""
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
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{_PACKAGE}."):
            assert node.module is not None
            yield node.module
