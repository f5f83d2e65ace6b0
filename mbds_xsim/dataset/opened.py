"""Open data files: whatever is wrong with one is said in one line that names it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from mbds_xsim.errors import InputError

__all__ = ["opened"]


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a data file to read.

    Raises:
        InputError: There is none, or what is read of it is truncated, damaged or something else.
    """
    if not path.exists():
        msg = f"{path}: there is no such file"
        raise InputError(msg)
    try:
        with h5py.File(path, "r") as file:
            yield file
    # HDF5 gives the first three for damage; the last is text that is none any more.
    except (OSError, RuntimeError, KeyError, UnicodeError) as error:
        msg = f"{path} cannot be read as HDF5 ({_brief(error)}); it is truncated or something else"
        raise InputError(msg) from error


def _brief(error: Exception) -> str:
    """What the library says behind its "Unable to …", on one line."""
    whole = " ".join(str(error.args[0] if error.args else error).split())
    _, bracket, cause = whole.partition("(")
    return cause.removesuffix(")") if bracket else whole
