"""Raw rows of trade-off studies as CSV, one start at one setting a line."""

from __future__ import annotations

import json

from mbds_xsim.safe_text import csv_text
from mbds_xsim.study.rows import Row

__all__ = ["to_csv"]

_LEFT_OUT = {"key"}


def to_csv(rows: list[Row]) -> bytes:
    """Give a header and a line a row; lists of repeats are separated by blanks."""
    fields = [name for name in Row.__struct_fields__ if name not in _LEFT_OUT]
    cells = ([_cell(getattr(row, name)) for name in fields] for row in rows)
    return csv_text([fields, *cells]).encode()


def _cell(value: object) -> object:
    if isinstance(value, dict):
        return json.dumps(value)
    if isinstance(value, tuple):
        separator = " " if all(isinstance(item, float) for item in value) else "; "
        return separator.join(str(item) for item in value)
    return value
