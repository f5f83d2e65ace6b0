"""Files that a study can write: pages, Markdown, CSV, JSON."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec

from mbds_xsim.base import text
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.text import as_code, csv_text, in_alt_text, in_markdown, printable, sentence
from mbds_xsim.report import blocks, themed
from mbds_xsim.report.blocks import Block, Cell, Column, Remarks, Report, Section, Table, Text
from mbds_xsim.report.terminal import SIGNS


def write_reports(
    reports: Sequence[Report],
    title: str,
    *,
    html: Path | None = None,
    markdown: Path | None = None,
) -> None:
    """Write the files that are named, each whole or not at all."""
    write_if(html, lambda: to_html(reports, title).encode())
    write_if(markdown, lambda: to_markdown(reports).encode())


def write_if(path: Path | None, content: Callable[[], bytes]) -> None:
    """Write a file if it is named, whole or not at all."""
    if path is not None:
        write_whole(path, content())


def link(picture: Path | None, page: Path | None) -> str:
    """Return a picture's address relative to a page's folder; "" if either is missing."""
    if picture is None or page is None:
        return ""
    # Blanks and brackets would end a Markdown link.
    return quote(os.fsencode(Path(os.path.relpath(picture, page.parent)).as_posix()))


def results_json(results: Sequence[msgspec.Struct]) -> bytes:
    """Encode one result as an object, several as a list."""
    return text.encoded(results[0] if len(results) == 1 else results)


def rows_csv(kind: type[msgspec.Struct], rows: Iterable[msgspec.Struct], *more: str) -> bytes:
    """Return CSV with a header and a line per row, all of one kind; without rows, the header.

    `more` names properties that are columns too. Blanks separate the numbers of a tuple.
    """
    names = [*(field for field in kind.__struct_fields__ if field != "key"), *more]
    cells = ([_csv_cell(getattr(row, name)) for name in names] for row in rows)
    return csv_text([names, *cells]).encode()


def _csv_cell(value: object) -> object:
    if isinstance(value, dict):
        return json.dumps(value)
    if isinstance(value, tuple):
        separator = " " if all(isinstance(item, float) for item in value) else "; "
        return separator.join(str(item) for item in value)
    return value


def to_html(reports: Sequence[Report], title: str) -> str:
    """Return a page with a chapter per report; the first motion in them can be played."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("mbds_xsim", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    places = itertools.count()
    environment.filters["sentence"] = sentence
    return environment.get_template("page.html").render(
        light=themed.LIGHT,
        dark=themed.DARK,
        reports=reports,
        title=title,
        signs=SIGNS,
        svg=lambda figure: themed.svg(
            figure.title, figure.draw, figure.size, figure.tips, next(places)
        ),
        motion=next((m.data for report in reports for m in blocks.motions_in(report.blocks)), None),
    )


def _finalized(value: Any) -> Any:
    """Drop control characters; text that is HTML already stays HTML."""
    return type(value)(printable(value)) if isinstance(value, str) else value


def to_markdown(reports: Iterable[Report]) -> str:
    """Return Markdown with a chapter per report; columns are explained at their first use."""
    explained: set[Column] = set()
    return "\n".join(_spaced(line for report in reports for line in _chapter(report, explained)))


def table_lines(headings: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """Lay out texts that are Markdown already, row by row as they come.

    Args:
        headings: Headings of the columns; `>` in front marks a column of figures.
        rows: Rows with as many texts each.
    """
    above = list(headings)
    yield _line(heading.removeprefix(">") for heading in above)
    yield _line("--:" if heading.startswith(">") else ":--" for heading in above)
    yield from map(_line, rows)


def table_text(headings: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Lay out texts that are Markdown already, as `table_lines` does."""
    return "".join(f"{line}\n" for line in table_lines(headings, rows))


def _line(texts: Iterable[str]) -> str:
    return f"| {' | '.join(texts)} |"


def _spaced(lines: Iterable[str]) -> Iterator[str]:
    """Separate lists from the text around them by one blank line."""
    above = ""
    for line in lines:
        if line and above and line.startswith("- ") != above.startswith("- "):
            yield ""
        if line or above:
            yield line
        above = line


def _chapter(report: Report, explained: set[Column]) -> Iterator[str]:
    title, what = in_markdown(report.title), in_markdown(report.what)
    yield from (f"# {title}: {what}", "")
    answer = f"{sentence(report.conclusion)}{sentence(report.description)}".rstrip()
    yield from (in_markdown(answer), "")
    if report.picture:
        told = in_alt_text(f"{report.title}, {report.what}")
        yield from (f"![{told}]({report.picture})", "")
    yield from _blocks(report.blocks, explained, 2)
    origin = f" on {in_markdown(report.made)}" if report.made else ""
    yield from (f"- Made by {as_code(report.command)}{origin}", "")


def _blocks(blocks: Iterable[Block], explained: set[Column], level: int) -> Iterator[str]:
    for block in blocks:
        match block:
            case Table():
                yield from _table(block, explained, level)
            case Text():
                yield from (in_markdown(sentence(block.text).rstrip()), "")
            case Remarks(lines):
                yield from (f"- {_bold(in_markdown(r.sentence), r.mark == 'fail')}" for r in lines)
            case Section() if "markdown" in block.on:
                if block.title:
                    yield from (f"{'#' * level} {in_markdown(block.title)}", "")
                yield from _blocks(block.blocks, explained, level + bool(block.title))


def _table(table: Table, explained: set[Column], level: int) -> Iterator[str]:
    if table.title:
        yield from (f"{'#' * level} {in_markdown(table.title)}", "")
    if table.note:
        yield from (in_markdown(sentence(table.note).rstrip()), "")
    headings = (f"{'' if c.words else '>'}{in_markdown(c.heading.strip())}" for c in table.columns)
    bold = ("over", "fail")
    rows = ((_cell(cell, bold=row.mark in bold) for cell in row.cells) for row in table.rows)
    yield from table_lines(headings, rows)
    yield ""
    for row in table.rows:
        name = in_markdown(" ".join(row.texts[:2]))
        yield from (f"- {name}: {in_markdown(reason)}" for reason in row.reasons)
    for column in table.columns:
        if column.meaning and column not in explained:
            explained.add(column)
            yield f"- {in_markdown(column.heading.strip())}: {in_markdown(column.meaning)}"
    if any(cell.mark == "over" for row in table.rows for cell in row.cells):
        yield "- Bold: over budget"


def _cell(cell: Cell, *, bold: bool) -> str:
    text = in_markdown(cell.text)
    if cell.mark in SIGNS and not text:
        return SIGNS[cell.mark]
    return _bold(text, bold or cell.mark in ("over", "strong"))


def _bold(text: str, really: bool) -> str:
    return f"**{text}**" if text and really else text
