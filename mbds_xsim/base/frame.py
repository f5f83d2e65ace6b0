"""Results as pandas data frames, where pandas is installed."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError


def frame_of(rows: Sequence[Any]) -> Any:
    """Give a `pandas.DataFrame` with a row for each struct and a column for each field.

    Raises:
        InputError: pandas is not installed.
    """
    try:
        from pandas import DataFrame
    except ImportError as error:
        msg = "to_frame() needs pandas, which is not installed: pip install 'mbds-xsim[frames]'"
        raise InputError(msg) from error
    return DataFrame([_fields(row) for row in rows])


def _fields(row: Any) -> dict[str, Any]:
    if isinstance(row, msgspec.Struct):
        return msgspec.structs.asdict(row)
    return {field.name: getattr(row, field.name) for field in dataclasses.fields(row)}
