"""Put bytes on the disk for good: whole, flushed, read back, and only then under their name."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from mbds_xsim.dataset.disk import reads_back, write_through
from mbds_xsim.errors import InputError

__all__ = ["PART", "clean", "put"]

PART = ".part"
"""Ending of files that are being written."""


def put(path: Path, content: bytes) -> None:
    """Write a file that is there whole after any crash, or not at all.

    Raises:
        InputError: It cannot be written, or does not read back as it was written.
    """
    part = path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_through(part, content)
        if not reads_back(part, content):
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


def clean(folder: Path) -> None:
    """Remove what writers left behind that were killed."""
    for part in folder.glob(f".*{PART}"):
        part.unlink(missing_ok=True)


def _flush_folder(folder: Path) -> None:
    """Make the new name as durable as the bytes."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
