"""Imports of optional packages, and conversion of results to pandas data frames."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError


def optional(module: str, wanted_by: str, extra: str) -> Any:
    """Import a module of an optional package.

    Raises:
        InputError: The package is not installed; the line says what needs it, and how to get it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{wanted_by} needs {module}, which is not installed: "
            f"pip install 'mbds-xsim[{extra}]' ({error})"
        ) from error


def frame_of(rows: Sequence[Any]) -> Any:
    """Return a `pandas.DataFrame` with a row for each struct and a column for each field.

    Raises:
        InputError: pandas is not installed.
    """
    pandas = optional("pandas", "to_frame()", "frames")
    return pandas.DataFrame([_fields(row) for row in rows])


def _fields(row: Any) -> dict[str, Any]:
    return msgspec.structs.asdict(row) if isinstance(row, msgspec.Struct) else vars(row)
