"""Write and read whole files past the system's cache, where the file system allows it.

What is read back then is what the disk has. And filling the cache with pages that nobody asks for
again costs as much processor time as ten times the writing.
"""

from __future__ import annotations

import errno
import mmap
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

__all__ = ["reads_back", "write_through"]

_DIRECT = getattr(os, "O_DIRECT", 0)
_BLOCK = 4096  # bytes; sizes and places in memory and file must be multiples of the disk's blocks
_PIECE = 2**21  # bytes

Answer = TypeVar("Answer")


def write_through(path: Path, content: bytes) -> None:
    """Write a file and flush it to the disk.

    Raises:
        OSError: As by the system.
    """
    _tried(lambda flags: _write(path, content, flags))


def reads_back(path: Path, content: bytes) -> bool:
    """Tell whether the disk has these bytes.

    Raises:
        OSError: As by the system.
    """
    return _tried(lambda flags: _read(path, content, flags))


def _tried(work: Callable[[int], Answer]) -> Answer:
    """Work past the cache, or through it where the file system refuses."""
    try:
        return work(_DIRECT)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        return work(0)


def _write(path: Path, content: bytes, flags: int) -> None:
    whole, piece = memoryview(content), _memory()
    with _opened(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | flags) as handle:
        for first in range(0, len(content), _PIECE):
            size = min(_PIECE, len(content) - first)
            piece[:size] = whole[first : first + size]
            rest = piece[: -(-size // _BLOCK) * _BLOCK]
            while rest:
                rest = rest[os.write(handle, rest) :]
        os.truncate(handle, len(content))
        os.fsync(handle)


def _read(path: Path, content: bytes, flags: int) -> bool:
    place, piece = 0, _memory()
    with _opened(path, os.O_RDONLY | flags) as handle:
        if os.fstat(handle).st_size != len(content):
            return False
        while place < len(content):
            count = os.readv(handle, [piece])
            if not count or not content.startswith(bytes(piece[:count]), place):
                return False
            place += count
    return True


@contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    handle = os.open(path, flags, 0o666)
    try:
        yield handle
    finally:
        os.close(handle)


def _memory() -> memoryview:
    """Give memory that begins at a block."""
    return memoryview(mmap.mmap(-1, _PIECE))
