"""Put files on the disk for good, in a folder in which one run works at a time.

A file is written under another name, flushed, read back and only then renamed. The system's cache
forgets it in between, where it can be asked to: what is read back is then what the disk has, and
pages that nobody asks for again do not push others out of the memory.
"""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from mbds_xsim.base.errors import InputError

_PART = ".part"  # ending of files that are being written
_LOCK = ".lock"
_PIECE = 2**21  # bytes that are read back at a time


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

    def clean() -> None:
        for part in (part for folder in every for part in folder.glob(f".*{_PART}")):
            part.unlink(missing_ok=True)

    clean()
    try:
        yield
    finally:
        clean()


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


def _write(path: Path, content: bytes) -> None:
    """Write a file and flush it to the disk."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
        _forget(file)


def _reads_back(path: Path, content: bytes) -> bool:
    """Tell whether the disk has these bytes."""
    place = 0
    with path.open("rb", buffering=0) as file:
        while piece := file.read(_PIECE):
            if not content.startswith(piece, place):
                return False
            place += len(piece)
        _forget(file)
    return place == len(content)


def _forget(file: IO[bytes]) -> None:
    """Take a file out of the system's cache, where there is a way to."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _flush_folder(folder: Path) -> None:
    """Make the new name as durable as the bytes."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
