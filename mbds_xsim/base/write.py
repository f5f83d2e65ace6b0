"""Write a file whole or not at all, and read one that cannot be waited for for ever."""

from __future__ import annotations

import errno
import gzip
import os
import tempfile
import zlib
from pathlib import Path

from mbds_xsim.base.errors import InputError


def path_of(name: str, value: object) -> Path:
    """Read a path; an empty text would be the folder one stands in.

    Raises:
        InputError: It is none.
    """
    if not isinstance(value, str | Path) or value == "":
        msg = f"{name}: got {value!r}, allowed is the path of a file or folder"
        raise InputError(msg)
    return Path(value)


def write_whole(path: Path, content: bytes) -> None:
    """Write under a temporary name in the same folder, then rename; make the folder if needed.

    A link keeps pointing where it did, and a device or pipe is written to in place. What is named
    `.gz` is packed, to the same bytes each time.

    Raises:
        InputError: The folder cannot be written to or the disk is full; nothing is left behind.
    """
    if path.suffix == ".gz":
        content = gzip.compress(content, mtime=0)
    try:
        if _is_stream(path):
            path.write_bytes(content)
        else:
            _replace(path.resolve(), content)
    except OSError as error:
        msg = f"cannot write {path}: {error.strerror or error}"
        raise InputError(msg) from error


def check_regular(path: Path) -> None:
    """Refuse a named pipe, whose reader waits for a writer, maybe for ever.

    Those in /dev are meant: a shell makes one of the output of a command, `<(command)`.

    Raises:
        OSError: It is one, or another thing that is neither file nor folder.
    """
    if _is_stream(path) and not path.is_dir() and path.parts[:2] != ("/", "dev"):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def read_file(path: Path, most: int = -1) -> bytes:
    """Read a file, unpacked where it is named `.gz`; no more than `most` bytes of it.

    Raises:
        OSError: It cannot be read, is not a regular file, or is named `.gz` and is no such file.
    """
    check_regular(path)
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        try:
            return file.read(most)
        except (EOFError, zlib.error) as error:
            raise gzip.BadGzipFile(f"was cut short or damaged: {error}") from error


def check_writable(path: Path, option: str) -> None:
    """Raise InputError, before long work, where `write_whole` would fail after it."""
    if str(path) == "-":
        msg = f"{option}: got -, but standard output is for --json alone; name a file"
        raise InputError(msg)
    if path.is_dir():
        msg = f"{option}: cannot write {path}: it is a folder; name a file"
        raise InputError(msg)
    if path.exists() and not os.access(path, os.W_OK):
        msg = f"{option}: cannot write {path}: it is read-only; name another file"
        raise InputError(msg)
    if _is_stream(path):
        return
    parents = path.absolute().parents
    folder = next(parent for parent in parents if os.path.lexists(parent))
    try:
        tempfile.TemporaryFile(dir=folder).close()  # what root may do, only trying tells
    except OSError as error:
        msg = f"{option}: cannot write {path}: {folder}: {error.strerror}; name another folder"
        raise InputError(msg) from error


def _is_stream(path: Path) -> bool:
    """Tell /dev/null, /dev/stdout or a named pipe, which must not be replaced by a file."""
    return path.exists() and not path.is_file()


def _replace(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".mbds-xsim-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
