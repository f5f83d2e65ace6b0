"""Code of other packages: it can neither change the folder nor exit, and its errors are located."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stdout

from mbds_xsim.base.errors import InputError


@contextmanager
def of_another_package() -> Iterator[None]:
    """Run another package's code so that it cannot change the folder or exit the process.

    Its prints go to stderr, because a program may parse the output of a command.
    """
    try:
        with chdir(os.curdir), redirect_stdout(sys.stderr):
            yield
    except SystemExit as error:
        raise RuntimeError(f"it exits with {error.code!r}") from error


@contextmanager
def located_in(kind: type) -> Iterator[None]:
    """Add to an error the line of a class's own file from which it came, if it came from there."""
    try:
        yield
    except Exception as error:
        file = getattr(sys.modules.get(kind.__module__), "__file__", None)
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == file]
        if lines and not isinstance(error, InputError):
            error.add_note(f"(line {lines[-1]} of {file})")
        raise


def in_a_line(error: Exception) -> str:
    """Describe an error, with its notes, in one line."""
    return " ".join("".join(traceback.format_exception_only(error)).split())
