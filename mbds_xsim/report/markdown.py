"""Reports as Markdown: what the terminal shows, and how it was made, to be kept."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from mbds_xsim.base.text import as_code, in_markdown, sentence
from mbds_xsim.report.blocks import Block, Cell, Column, Remarks, Report, Section, Table, Text
from mbds_xsim.report.terminal import SIGNS


def to_markdown(reports: Iterable[Report]) -> str:
    """Give a chapter a report; what a column means is told where it first stands."""
    told: set[Column] = set()
    return "\n".join(_spaced(line for report in reports for line in _chapter(report, told)))


def table_lines(headings: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """Lay out texts that are Markdown already, row by row as they come.

    Args:
        headings: What stands above the columns; after `>` that of a column of figures.
        rows: As many texts each.
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
    """Part lists from what stands around them by one blank line."""
    above = ""
    for line in lines:
        if line and above and line.startswith("- ") != above.startswith("- "):
            yield ""
        if line or above:
            yield line
        above = line


def _chapter(report: Report, told: set[Column]) -> Iterator[str]:
    yield from (f"# {in_markdown(report.title)}: {in_markdown(report.what)}", "")
    answer = f"{sentence(report.conclusion)}{sentence(report.description)}".rstrip()
    yield from (in_markdown(answer), "")
    if report.picture:
        yield from (
            f"![{in_markdown(report.title)}, {in_markdown(report.what)}]({report.picture})",
            "",
        )
    yield from _blocks(report.blocks, told, 2)
    made = f" on {in_markdown(report.made)}" if report.made else ""
    yield from (f"- Made by {as_code(report.command)}{made}", "")


def _blocks(blocks: Iterable[Block], told: set[Column], level: int) -> Iterator[str]:
    for block in blocks:
        match block:
            case Table():
                yield from _table(block, told, level)
            case Text():
                yield from (in_markdown(sentence(block.text).rstrip()), "")
            case Remarks(lines):
                yield from (f"- {_bold(in_markdown(r.sentence), r.mark == 'fail')}" for r in lines)
            case Section() if "markdown" in block.on:
                if block.title:
                    yield from (f"{'#' * level} {in_markdown(block.title)}", "")
                yield from _blocks(block.blocks, told, level + bool(block.title))


def _table(table: Table, told: set[Column], level: int) -> Iterator[str]:
    if table.title:
        yield from (f"{'#' * level} {in_markdown(table.title)}", "")
    if table.note:
        yield from (in_markdown(sentence(table.note).rstrip()), "")
    headings = (f"{'' if c.words else '>'}{in_markdown(c.heading.strip())}" for c in table.columns)
    bold = ("over", "fail")
    rows = ((_cell(cell, bold=row.mark in bold) for cell in row.cells) for row in table.rows)
    yield from table_lines(headings, rows)
    yield ""
    reasons = [(row.cells, reason) for row in table.rows for reason in row.reasons]
    for cells, reason in reasons:
        yield f"- {in_markdown(' '.join(cell.text for cell in cells[:2]))}: {in_markdown(reason)}"
    for column in table.columns:
        if column.meaning and column not in told:
            told.add(column)
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
