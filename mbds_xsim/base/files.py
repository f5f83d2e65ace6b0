"""Files written whole or not at all and read without hanging, and folders locked by one run.

A file that is kept for good is written under a temporary name, flushed, read back and only then
renamed. Where the system allows, the file is dropped from its cache in between. The bytes read back
then come from the disk, and pages that are not needed again do not push others out of memory.
"""

from __future__ import annotations

import errno
import fcntl
import glob
import gzip
import os
import re
import socket
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from mbds_xsim.base.errors import InputError

_ENDINGS = {
    "--json": ".json", "--csv": ".csv", "--markdown": ".md", "--html": ".html", "--png": ".png",
    "--rollouts": ".png", "page": ".html", "path": ".toml",
}  # fmt: skip
_DATA = (
    ".h5", ".hdf5", ".npz", ".pt", ".toml", ".xml", ".urdf", ".sdf", ".usd", ".usda", ".usdc",
)  # fmt: skip


def path_of(name: str, value: object) -> Path:
    """Convert a value to a path; refuse an empty text, which would mean the current folder.

    Raises:
        InputError: The value is not a path.
    """
    if not isinstance(value, str | Path) or value == "":
        raise InputError(f"{name}: got {value!r}, allowed is the path of a file or folder")
    return Path(value)


def write_whole(path: Path, content: bytes) -> None:
    """Write under a temporary name in the same folder, then rename; make the folder if needed.

    A symbolic link stays a link, and a device or pipe is written to in place. A file named `.gz` is
    compressed, to the same bytes each time.

    Raises:
        InputError: The folder cannot be written to or the disk is full; nothing is left behind.
    """
    if path.suffix == ".gz":
        content = gzip.compress(content, mtime=0)
    try:
        if _is_stream(path):
            path.write_bytes(content)
        else:
            _replace(Path(os.path.realpath(path)), content)  # which a link to itself cannot stop
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error


def check_regular(path: Path) -> None:
    """Refuse a named pipe, whose reader may wait for a writer forever.

    Paths in /dev are allowed, since a shell passes the output of a command as one: `<(command)`.

    Raises:
        OSError: The path is a pipe, or something else that is neither file nor folder.
    """
    if _is_stream(path) and not path.is_dir() and path.parts[:2] != ("/", "dev"):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def read_file(path: Path, most: int = -1) -> bytes:
    """Read a file, decompressed if it is named `.gz`; at most `most` bytes, or all if negative.

    Raises:
        OSError: It cannot be read, is not a regular file, or is named `.gz` but is not gzip.
    """
    check_regular(path)
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        try:
            return file.read(most)
        except (EOFError, zlib.error) as error:
            raise gzip.BadGzipFile(f"was cut short or damaged: {error}") from error


def read_bounded(
    path: Path, most: int, remark: str, refusal: type[InputError] = InputError
) -> bytes:
    """Read a file as `read_file` does; refuse one of more than `most` bytes, whole megabytes."""
    content = read_file(path, most + 1)
    if len(content) > most:
        raise refusal(f"{path}: got more than {most // 10**6} MB{remark}")
    return content


def check_writable(path: Path, option: str) -> None:
    """Raise InputError before long work if `write_whole` would fail after it."""
    if str(path) == "-":
        raise InputError(f"{option}: got -, but standard output is for --json alone; name a file")
    if path.is_dir():
        raise InputError(f"{option}: cannot write {path}: it is a folder; name a file")
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError(f"{option}: cannot write {path}: it is read-only; name another file")
    if _is_stream(path):
        return
    folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
    try:
        tempfile.TemporaryFile(dir=folder).close()  # only trying shows what root may do
    except OSError as error:
        msg = f"{option}: cannot write {path}: {folder}: {error.strerror}; name another folder"
        raise InputError(msg) from error


def check_ending(path: Path, option: str) -> None:
    """Raise InputError if an output is named like another kind of file, which it might replace."""
    ending, due = path.suffix.lower(), _ENDINGS.get(option)
    picture = due == ".png"
    other = ending not in ("", due, ".gz") if picture else ending in _DATA and ending != due
    if due and other:
        cause = "pictures are PNG" if picture else f"it writes no {ending}"
        raise InputError(f"{option}: got {path}, but {cause}; name it {path.with_suffix(due).name}")


def named_in(words: Iterable[str]) -> set[str]:
    """Return the real paths that command-line words may name, also within lists and patterns."""
    parts = {part for word in words for part in re.split("[=,]", word)}
    return {os.path.realpath(path) for part in parts for path in (part, *glob.glob(part))}


def _is_stream(path: Path) -> bool:
    """Return whether a path exists but is no file: never replace /dev/null or a named pipe."""
    return path.exists() and not path.is_file()


def _replace(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".mbds-xsim-{os.urandom(8).hex()}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


_PART = ".part"  # ending of files that are being written
_LOCK = ".lock"
_PART_BYTES = 2**21  # read back at a time


def put(path: Path, *pieces: bytes | memoryview) -> None:
    """Write pieces one after the other to a file, which is whole or absent after any crash.

    Raises:
        InputError: The file cannot be written, or does not read back as it was written.
    """
    part = path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}{_PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(part, pieces)
        if not _reads_back(part, pieces):
            msg = f"cannot write {path}: what was written does not read back; check the disk"
            raise InputError(msg)
        os.replace(part, path)
        _flush_folder(path.parent)
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror or error}; fix that, then run the "
            "same command again: finished work is kept"
        ) from error
    finally:
        with suppress(OSError):  # there is no part if the folder's name is taken by a file
            part.unlink()


@contextmanager
def tidied(folders: Iterable[Path]) -> Iterator[None]:
    """Remove the partial files of killed writers, both before and after the block."""
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
        except BlockingIOError as error:
            owner = file.read(64).decode(errors="replace").strip() or "another process"
            msg = f"{folder} is in use by {owner}; wait until that run has ended or name another"
            raise InputError(f"{msg} --out") from error
        except OSError as error:
            msg = f"--out: cannot lock {folder}: {error.strerror}; name a folder of a file system"
            raise InputError(f"{msg} that has locks (flock)") from error
        file.truncate(0)
        file.write(f"process {os.getpid()}".encode())
        yield


Pieces = tuple[bytes | memoryview, ...]


def _write(path: Path, pieces: Pieces) -> None:
    """Write a file and flush it to the disk."""
    with path.open("wb") as file:
        file.writelines(pieces)
        file.flush()
        os.fsync(file.fileno())
        _forget(file)


def _reads_back(path: Path, pieces: Pieces) -> bool:
    """Return whether the file on the disk has exactly these bytes."""
    with path.open("rb") as file:
        same = all(_follows(file, memoryview(piece)) for piece in pieces) and not file.read(1)
        _forget(file)
    return same


def _follows(file: IO[bytes], piece: memoryview) -> bool:
    """Return whether a file continues with these bytes."""
    parts = (piece[at : at + _PART_BYTES] for at in range(0, len(piece), _PART_BYTES))
    return all(file.read(len(part)).startswith(part) for part in parts)


def _forget(file: IO[bytes]) -> None:
    """Drop a file from the system's cache, where the system allows it."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _flush_folder(folder: Path) -> None:
    """Make a new file name as durable as the bytes of the file."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
