"""Cells of stability studies as CSV, one run a line."""

from __future__ import annotations

import json

from mbds_xsim.safe_text import csv_text
from mbds_xsim.study.stability.rows import Cell, Sweep

__all__ = ["to_csv"]

_LEFT_OUT = {"key"}


def to_csv(sweeps: list[Sweep]) -> bytes:
    """Give a header and a line a cell; whether it failed silently is the last column."""
    fields = [name for name in Cell.__struct_fields__ if name not in _LEFT_OUT]
    cells = (
        [*(_cell(getattr(cell, name)) for name in fields), cell.silent]
        for sweep in sweeps
        for cell in sweep.cells
    )
    return csv_text([[*fields, "silent"], *cells]).encode()


def _cell(value: object) -> object:
    return json.dumps(value) if isinstance(value, dict) else value
