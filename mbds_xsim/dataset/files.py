"""Put files on the disk for good, in a folder in which one run works at a time.

A file is written under another name, flushed, read back and only then renamed. Both ways go past
the system's cache where the file system allows it: what is read back is then what the disk has,
and filling the cache with pages that nobody asks for again costs ten times the writing.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from mbds_xsim.base.errors import InputError

_PART = ".part"  # ending of files that are being written
_LOCK = ".lock"
_DIRECT = getattr(os, "O_DIRECT", 0)
_BLOCK = 4096  # bytes; sizes and places in memory and file must be multiples of the disk's blocks
_PIECE = 2**21  # bytes

Answer = TypeVar("Answer")


def put(path: Path, content: bytes) -> None:
    """Write a file that is there whole after any crash, or not at all.

    Raises:
        InputError: It cannot be written, or does not read back as it was written.
    """
    part = path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}{_PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(part, content)
        if not _reads_back(part, content):
            msg = f"cannot write {path}: what was written does not read back; check the disk"
            raise InputError(msg)
        os.replace(part, path)
        _flush_folder(path.parent)
    except OSError as error:
        msg = (
            f"cannot write {path}: {error.strerror or error}; what is finished is kept, run the "
            "same command again to go on"
        )
        raise InputError(msg) from error
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def tidied(folders: Iterable[Path]) -> Iterator[None]:
    """Remove what writers left behind that were killed, before the block and in it."""
    every = list(folders)
    try:
        _clean(every)
        yield
    finally:
        _clean(every)


def _clean(folders: list[Path]) -> None:
    for folder in folders:
        for part in folder.glob(f".*{_PART}"):
            part.unlink(missing_ok=True)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the folder, making it if needed; the system unlocks it however the process ends.

    Raises:
        InputError: Another run has locked it, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        msg = f"--out: cannot write to {folder}: {error.strerror}; name another folder"
        raise InputError(msg) from error
    with os.fdopen(handle, "r+b", buffering=0) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = file.read(64).decode(errors="replace").strip() or "another process"
            msg = f"{folder} is in use by {owner}; wait until that run has ended or name another"
            raise InputError(f"{msg} --out") from error
        file.truncate(0)
        file.write(f"process {os.getpid()}".encode())
        yield


def _past_cache(work: Callable[[Path, bytes, int], Answer]) -> Callable[[Path, bytes], Answer]:
    """Have it done past the cache, or through it where the file system refuses."""

    def attempt(path: Path, content: bytes) -> Answer:
        try:
            return work(path, content, _DIRECT)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            return work(path, content, 0)

    return attempt


@_past_cache
def _write(path: Path, content: bytes, flags: int) -> None:
    """Write a file and flush it to the disk."""
    whole, piece = memoryview(content), _block_memory()
    with _handle(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | flags) as handle:
        for first in range(0, len(content), _PIECE):
            size = min(_PIECE, len(content) - first)
            piece[:size] = whole[first : first + size]
            rest = piece[: -(-size // _BLOCK) * _BLOCK]
            while rest:
                rest = rest[os.write(handle, rest) :]
        os.truncate(handle, len(content))
        os.fsync(handle)


@_past_cache
def _reads_back(path: Path, content: bytes, flags: int) -> bool:
    """Tell whether the disk has these bytes."""
    place, piece = 0, _block_memory()
    with _handle(path, os.O_RDONLY | flags) as handle:
        if os.fstat(handle).st_size != len(content):
            return False
        while place < len(content):
            count = os.readv(handle, [piece])
            if not count or not content.startswith(bytes(piece[:count]), place):
                return False
            place += count
    return True


def _flush_folder(folder: Path) -> None:
    """Make the new name as durable as the bytes."""
    with _handle(folder, os.O_RDONLY) as handle:
        os.fsync(handle)


@contextmanager
def _handle(path: Path, flags: int) -> Iterator[int]:
    handle = os.open(path, flags, 0o666)
    try:
        yield handle
    finally:
        os.close(handle)


def _block_memory() -> memoryview:
    """Give memory that begins at a block."""
    return memoryview(mmap.mmap(-1, _PIECE))
