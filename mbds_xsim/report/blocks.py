"""Pieces of a report: the content of a study, independent of how it is shown.

A study presents its result as a `Report` of blocks. The terminal, Markdown and pages each know how
to show every kind of block, and know no study. Texts may come from strangers: each renderer makes
them safe for its place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

if TYPE_CHECKING:
    from mbds_xsim.report.themed import Style

Mark: TypeAlias = Literal["", "pass", "warn", "fail", "over", "strong", "muted"]
"""Status of a text: a verdict, a figure beyond its budget, or a tone."""
Place: TypeAlias = Literal["terminal", "markdown", "page"]
EVERYWHERE: frozenset[Place] = frozenset({"terminal", "markdown", "page"})
WRITTEN: frozenset[Place] = frozenset({"markdown", "page"})
PAGE: frozenset[Place] = frozenset({"page"})


@dataclass(frozen=True)
class Cell:
    """Text in a table; the sign of a verdict is put before it, even if it is empty."""

    text: str
    mark: Mark = ""
    line: Style | None = None
    """Style of the curves that the row is about, if any."""


@dataclass(frozen=True)
class Column:
    """Column of a table: its heading, and a sentence on its meaning (a tool tip on a page)."""

    heading: str
    meaning: str = ""
    words: bool = False
    """Whether it holds words rather than figures, set flush left."""
    narrow: bool = True
    """Whether a narrow terminal shows it too."""


@dataclass(frozen=True)
class Row:
    """Cells of a row, and sentences that give reasons for its mark."""

    cells: tuple[Cell, ...]
    mark: Mark = ""
    reasons: tuple[str, ...] = ()

    @property
    def texts(self) -> tuple[str, ...]:
        """Texts of the cells."""
        return tuple(cell.text for cell in self.cells)


@dataclass(frozen=True)
class Table:
    """Rows under headings, with a note."""

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    title: str = ""
    note: str = ""
    most: int | None = None
    """Largest number of rows that a terminal shows; None for all."""
    grouped: bool = False
    """Whether a terminal shows equal first cells of successive rows only once."""
    folded: bool = False
    """Whether a page shows only the title until it is opened."""


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    mark: Mark = ""


@dataclass(frozen=True)
class Remark:
    """Subject, and a sentence about it."""

    subject: str
    """Subject of the sentence; may be a question."""
    text: str
    mark: Mark = ""

    @property
    def begin(self) -> str:
        """Subject with the separator before the sentence."""
        return f"{self.subject}{'' if self.subject.endswith('?') else ':'} "

    @property
    def sentence(self) -> str:
        """Subject and sentence together."""
        return f"{self.begin}{self.text}"


@dataclass(frozen=True)
class Remarks:
    """Further remarks, one line each."""

    lines: tuple[Remark, ...]
    most: int | None = None
    """Largest number of lines that a terminal shows; None for all."""

    @classmethod
    def of(cls, pairs: Iterable[tuple[str, str]]) -> Remarks:
        """Make remarks from pairs of a subject and a sentence."""
        return cls(tuple(Remark(subject, text) for subject, text in pairs))


@dataclass(frozen=True, eq=False)
class Figure:
    """Drawing by matplotlib, shown as SVG on pages."""

    title: str
    """Description for those who do not see it."""
    draw: Callable[[Any], None]
    """Function that draws on the figure it is given."""
    size: tuple[float, float] = (5.4, 3.7)
    """Width and height [in]."""
    tips: dict[str, str] = field(default_factory=dict)
    """Tool tips by the gid of an artist (`tip-…`)."""
    caption: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Key:
    """An entry of a legend."""

    name: str
    colour: str = ""
    letter: str = ""
    curve: str = ""
    """Class of the artists that a tick box shows and hides: `curve-…` without `curve-`."""
    hatched: bool = False
    dark: bool = False


@dataclass(frozen=True)
class Legend:
    """Meaning of colours and letters in the figures below."""

    keys: tuple[Key, ...]


@dataclass(frozen=True)
class FigureGroup:
    """Figures side by side."""

    figures: tuple[Figure, ...]
    least: int = 375
    """Least width of each figure [px]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Motions to play in the viewer of pages."""

    data: dict[str, Any]
    """Data that the viewer reads: see `mbds_xsim.report.motion`."""
    truth: str
    """Name of the motion that the others are drawn over."""
    entries: tuple[tuple[str, Style], ...]
    """Names and styles of the others."""
    contact: tuple[Table, ...] = ()
    """Table for each trajectory, under strips of its contact over time; needs data on contact."""
    contact_words: tuple[str, str] = ("", "")
    """Texts before and after the strips."""


@dataclass(frozen=True)
class Section:
    """Blocks under a heading, folded away on pages if they are details."""

    title: str
    blocks: tuple[Block, ...]
    folded: bool = False
    opened: bool = False
    verdict: Mark = ""
    line: Style | None = None
    """Style of the curves that it is about."""
    on: frozenset[Place] = EVERYWHERE


Block: TypeAlias = Table | Text | Remarks | FigureGroup | Legend | Motion | Section


@dataclass(frozen=True)
class Report:
    """Result for people: the answer first (on a terminal last), then the evidence."""

    title: str
    what: str
    """Addition to the title; with a verdict, the verdict in words."""
    conclusion: str
    blocks: tuple[Block, ...]
    command: str
    """Command that makes the result again."""
    made: str = ""
    """How it was made: time, machine, versions."""
    description: str = ""
    verdict: Mark = ""
    picture: str = ""
    """Link to a picture of the result, for Markdown."""


def motions_in(blocks: Iterable[Block]) -> Iterator[Motion]:
    """Yield the motions, also those in sections."""
    for block in blocks:
        if isinstance(block, Motion):
            yield block
        elif isinstance(block, Section):
            yield from motions_in(block.blocks)


def table_of(
    columns: Iterable[Column | str],
    rows: Iterable[Row | Iterable[Cell | str]],
    **more: Any,
) -> Table:
    """Make a table of plain texts and cells, under columns or headings; `more` are its fields.

    A heading has words below it, or figures if it begins with `>`.
    """
    above = (
        Column(c.removeprefix(">"), words=not c.startswith(">")) if isinstance(c, str) else c
        for c in columns
    )
    below = (row if isinstance(row, Row) else row_of(row) for row in rows)
    return Table(tuple(above), tuple(below), **more)


def row_of(cells: Iterable[Cell | str], mark: Mark = "", reasons: tuple[str, ...] = ()) -> Row:
    """Make a row of plain texts and cells."""
    return Row(tuple(c if isinstance(c, Cell) else Cell(c) for c in cells), mark, reasons)


def chart(
    title: str, draw: Callable[[Any], None], size: tuple[float, float], **more: Any
) -> Figure:
    """Make a figure of one chart, which `draw` draws on axes; `more` are fields of the figure."""
    return Figure(title, lambda figure: draw(figure.subplots()), size, **more)


def plots(
    title: str, figures: Iterable[Figure | None], text: str = "", *, folded: bool = False
) -> Iterator[Section]:
    """Yield a section of figures that only a page shows, below a text; nothing without figures."""
    drawn = tuple(figure for figure in figures if figure is not None)
    if drawn:
        words = (Text(text),) if text else ()
        yield Section(title, (*words, FigureGroup(drawn)), folded, on=PAGE)
