"""The files that a study is asked for; a page is one HTML file that needs nothing else."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
from markupsafe import Markup

from mbds_xsim.base.text import csv_text, printable, sentence
from mbds_xsim.base.write import write_whole
from mbds_xsim.report import palette, themed
from mbds_xsim.report.blocks import Block, Figure, Motion, Report, Section
from mbds_xsim.report.markdown import to_markdown
from mbds_xsim.report.terminal import SIGNS

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


def to_html(reports: Sequence[Report], title: str) -> str:
    """Give the page; the motion of the first report that has one can be played.

    Args:
        reports: A chapter each.
        title: Of the page.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("mbds_xsim", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sentence"] = sentence
    return environment.get_template("page.html").render(
        light=palette.LIGHT,
        dark=palette.DARK,
        reports=reports,
        title=title,
        signs=SIGNS,
        svg=_svg,
        motion=next((m.data for report in reports for m in _motions(report.blocks)), None),
    )


def _svg(figure: Figure) -> Markup:
    return themed.svg(figure.title, figure.draw, figure.size, figure.tips)


def _motions(blocks: Iterable[Block]) -> Iterator[Motion]:
    for block in blocks:
        if isinstance(block, Motion):
            yield block
        elif isinstance(block, Section):
            yield from _motions(block.blocks)


def _finalized(value: Any) -> Any:
    """Drop control characters; text that is HTML already stays so."""
    return type(value)(printable(value)) if isinstance(value, str) else value
