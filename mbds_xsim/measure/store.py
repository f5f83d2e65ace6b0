"""Rows of long studies kept on disk, so that one that was interrupted goes on where it stopped.

A file of lines, each a checksum and a row as JSON: a row is appended whole in one write, and a line
that was cut off or changed, or that another version wrote, is passed over.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import counted
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.reference.cache import directory, key_of
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.simulator import Simulator


class Keyed(msgspec.Struct, frozen=True, kw_only=True):
    """A row that can be kept."""

    key: str
    """Hash of all that decides the figures."""


R = TypeVar("R", bound=Keyed)


class Store(Generic[R]):
    """Rows of one kind by their keys; the latest of a key counts."""

    def __init__(self, path: Path, kind: type[R]) -> None:
        self.path = path
        self.rows: dict[str, R] = {row.key: row for row in _read(path, kind)}

    @classmethod
    def of(cls, study: str, subject: str, kind: type[R]) -> Store[R]:
        """Open the store of a study's rows about a subject in the user's cache directory."""
        safe = "".join(c if c.isalnum() or c in "-_." else "_" for c in subject)
        return cls(directory() / study / f"{safe}.jsonl", kind)

    def add(self, row: R) -> None:
        """Keep a row.

        Raises:
            InputError: It cannot be written.
        """
        self.rows[row.key] = row
        # A line of its own even after one that was cut off.
        row_text = msgspec.json.encode(row)
        line = b"\n" + _sum(row_text) + b" " + row_text + b"\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            try:
                os.write(handle, line)
            finally:
                os.close(handle)
        except OSError as error:
            msg = f"cannot keep rows in {self.path}: {error.strerror}; set MBDS_XSIM_CACHE"
            raise InputError(msg) from error


def _read(path: Path, kind: type[R]) -> Iterator[R]:
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        checksum, _, text = line.partition(b" ")
        if checksum == _sum(text):
            with contextlib.suppress(msgspec.DecodeError):
                yield msgspec.json.decode(text, type=kind)


def _sum(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:16].encode()


def row_key(scene: Scene, start: Batch, simulator: Simulator, count: int) -> str:
    """Name a row by its content.

    It covers the physics, the start and its inputs, the budgets, the simulator at a number of
    steps a frame, the versions of all that runs and judges it, and the machine.
    """
    what = [
        key_of("tradeoff", scene, start, 0, 0.0),
        scene.budget,
        *simulator.decisive(scene, count),
        CHECKS,
        registry.package_version("numpy"),
        machine(),
    ]
    return hashlib.sha256(msgspec.json.encode(what, enc_hook=float)).hexdigest()


def versions_of(packages: Mapping[str, str]) -> dict[str, str]:
    """List the versions behind a result: of this toolkit, and of the packages that ran."""
    own = {name: registry.package_version(name) for name in ("mbds-xsim", "numpy", "scipy")}
    return own | {"python": platform.python_version()} | dict(packages)


@functools.cache
def machine() -> str:
    """Processor, cores and system."""
    cores = counted(os.cpu_count(), "core")
    return f"{_processor()}, {cores}, {platform.system()} {platform.machine()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown processor"
