"""Cells of stability studies as CSV, one run a line."""

from __future__ import annotations

import csv
import io
import json

import msgspec

from mbds_xsim.study.stability.rows import Cell, Sweep

__all__ = ["to_csv"]

_LEFT_OUT = {"key"}


def to_csv(sweeps: list[Sweep]) -> bytes:
    """Give a header and a line a cell; whether it failed silently is the last column."""
    fields = [name for name in Cell.__struct_fields__ if name not in _LEFT_OUT]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*fields, "silent"])
    for sweep in sweeps:
        for cell in sweep.cells:
            plain = msgspec.structs.asdict(cell)
            writer.writerow([*(_cell(plain[name]) for name in fields), cell.silent])
    return stream.getvalue().encode()


def _cell(value: object) -> object:
    if isinstance(value, dict):
        return json.dumps(value)
    return "" if value is None else value
