"""The files that a study is asked for."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec

from mbds_xsim.base.safe_text import csv_text
from mbds_xsim.base.write import write_whole
from mbds_xsim.report.blocks import Report
from mbds_xsim.report.markdown import to_markdown

_LEFT_OUT = {"key"}


def write_reports(
    reports: Sequence[Report],
    title: str,
    *,
    html: Path | None = None,
    markdown: Path | None = None,
) -> None:
    """Write those that are named, each whole or not at all."""
    if html is not None:
        from mbds_xsim.report.page import to_html

        write_whole(html, to_html(reports, title).encode())
    write_if(markdown, lambda: to_markdown(reports).encode())


def write_if(path: Path | None, content: Callable[[], bytes]) -> None:
    """Write a file if it is named, whole or not at all."""
    if path is not None:
        write_whole(path, content())


def link(picture: Path | None, page: Path | None) -> str:
    """Name a picture from the folder of a page; "" where there is none."""
    if picture is None or page is None:
        return ""
    return Path(os.path.relpath(picture, page.parent)).as_posix()


def results_json(results: Sequence[msgspec.Struct]) -> bytes:
    """Write one result as an object, several as a list; NaN and infinities become null."""
    what = results[0] if len(results) == 1 else results
    return msgspec.json.format(msgspec.json.encode(what), indent=2)


def rows_csv(rows: Iterable[msgspec.Struct], *more: str) -> bytes:
    """Give a header and a line a row; numbers of a tuple are separated by blanks.

    Args:
        rows: Of one kind, at least one.
        more: Names of properties that are columns too.
    """
    listed = list(rows)
    fields = (
        [name for name in listed[0].__struct_fields__ if name not in _LEFT_OUT] if listed else []
    )
    names = [*fields, *more]
    cells = ([_cell(getattr(row, name)) for name in names] for row in listed)
    return csv_text([names, *cells]).encode()


def _cell(value: object) -> object:
    if isinstance(value, dict):
        return json.dumps(value)
    if isinstance(value, tuple):
        separator = " " if all(isinstance(item, float) for item in value) else "; "
        return separator.join(str(item) for item in value)
    return value
