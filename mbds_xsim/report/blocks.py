"""Pieces of a report: what a study has to say, not how it is shown.

A study presents its result as a `Report` of blocks; the terminal, Markdown and pages each know how
to show every kind of block, and know no study. Texts may come from strangers: each renderer makes
them safe for its place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

if TYPE_CHECKING:
    from mbds_xsim.report.themed import Style

Mark: TypeAlias = Literal["", "pass", "warn", "fail", "over", "strong", "muted"]
"""How something stands: a verdict, a figure beyond its budget, or a tone."""
Place: TypeAlias = Literal["terminal", "markdown", "page"]
EVERYWHERE: frozenset[Place] = frozenset({"terminal", "markdown", "page"})


@dataclass(frozen=True)
class Cell:
    """A text in a table; a verdict's sign stands before it, even before none."""

    text: str
    mark: Mark = ""
    line: Style | None = None
    """Look of the curves that the row is about, where there are any."""


@dataclass(frozen=True)
class Column:
    """A column: what it is called, and what it says in a sentence (a tool tip on a page)."""

    heading: str
    meaning: str = ""
    words: bool = False
    """Words rather than figures: set flush left."""
    narrow: bool = True
    """Whether a narrow terminal has it too."""


@dataclass(frozen=True)
class Row:
    """Cells of a row, and sentences that say why it stands so."""

    cells: tuple[Cell, ...]
    mark: Mark = ""
    reasons: tuple[str, ...] = ()

    @property
    def texts(self) -> tuple[str, ...]:
        """Texts of the cells."""
        return tuple(cell.text for cell in self.cells)


@dataclass(frozen=True)
class Table:
    """Rows under headings, with a sentence below."""

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    title: str = ""
    note: str = ""
    most: int | None = None
    """Rows that a terminal shows."""
    grouped: bool = False
    """Whether a terminal shows equal first cells once."""
    folded: bool = False
    """Whether a page shows the title alone until it is opened."""


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    mark: Mark = ""


@dataclass(frozen=True)
class Remark:
    """A subject, and a sentence of it."""

    subject: str
    """May be a question."""
    text: str
    mark: Mark = ""

    @property
    def begin(self) -> str:
        """The subject, parted from the sentence."""
        return f"{self.subject}{'' if self.subject.endswith('?') else ':'} "

    @property
    def sentence(self) -> str:
        """Both."""
        return f"{self.begin}{self.text}"


@dataclass(frozen=True)
class Remarks:
    """What else is to be said, one line each."""

    lines: tuple[Remark, ...]
    most: int | None = None
    """Lines that a terminal shows."""

    @classmethod
    def of(cls, pairs: Iterable[tuple[str, str]], most: int | None = None) -> Remarks:
        """Make remarks of subjects and sentences."""
        return cls(tuple(Remark(subject, text) for subject, text in pairs), most)


@dataclass(frozen=True, eq=False)
class Figure:
    """A drawing by matplotlib: on pages as SVG."""

    title: str
    """For those who do not see it."""
    draw: Callable[[Any], None]
    """Draws on the figure it is given."""
    size: tuple[float, float] = (5.4, 3.7)
    """Width and height [in]."""
    tips: dict[str, str] = field(default_factory=dict)
    """By gid of an artist (`tip-…`), what it tells when pointed at."""
    caption: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Key:
    """An entry of a legend."""

    name: str
    colour: str = ""
    letter: str = ""
    curve: str = ""
    """Class of the artists that a tick shows and hides: `curve-…` without `curve-`."""
    hatched: bool = False
    dark: bool = False


@dataclass(frozen=True)
class Legend:
    """What colours and letters of the figures below mean."""

    keys: tuple[Key, ...]


@dataclass(frozen=True)
class FigureGroup:
    """Figures side by side."""

    figures: tuple[Figure, ...]
    least: int = 375
    """Width that each has at least [px]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Motions to be played, by the viewer of pages."""

    data: dict[str, Any]
    """What the viewer reads: see `mbds_xsim.report.motion`."""
    truth: str
    """What the others are drawn over."""
    entries: tuple[tuple[str, Style], ...]
    """Names and looks of the others."""
    contact: tuple[Table, ...] = ()
    """Of each trajectory, under strips of its contact over time; needs data on contact."""
    contact_words: tuple[str, str] = ("", "")
    """Before and after the strips."""


@dataclass(frozen=True)
class Section:
    """Blocks under a heading, folded away on pages if they are details."""

    title: str
    blocks: tuple[Block, ...]
    folded: bool = False
    opened: bool = False
    verdict: Mark = ""
    line: Style | None = None
    """Look of the curves that it is about."""
    on: frozenset[Place] = EVERYWHERE


Block: TypeAlias = Table | Text | Remarks | FigureGroup | Legend | Motion | Section


@dataclass(frozen=True)
class Report:
    """A result as people read it: its answer first (on a terminal last), then what is behind it."""

    title: str
    what: str
    """What the title's subject was asked; with a verdict, that in words."""
    conclusion: str
    blocks: tuple[Block, ...]
    command: str
    """That makes it again."""
    made: str = ""
    """How it was made: time, machine, versions."""
    description: str = ""
    verdict: Mark = ""
    picture: str = ""
    """Link to a picture of it, for Markdown."""


def table_of(
    columns: Iterable[Column | str],
    rows: Iterable[Row | Iterable[Cell | str]],
    *,
    title: str = "",
    note: str = "",
    most: int | None = None,
    grouped: bool = False,
) -> Table:
    """Make a table of plain texts and cells, under columns or headings as in `columns_of`."""
    made = (row if isinstance(row, Row) else row_of(row) for row in rows)
    return Table(columns_of(*columns), tuple(made), title, note, most, grouped)


def row_of(cells: Iterable[Cell | str], mark: Mark = "", reasons: tuple[str, ...] = ()) -> Row:
    """Make a row of plain texts and cells."""
    return Row(tuple(c if isinstance(c, Cell) else Cell(c) for c in cells), mark, reasons)


def columns_of(*headings: Column | str) -> tuple[Column, ...]:
    """Make columns of their headings: of words, or after `>` of figures."""
    return tuple(
        Column(h.removeprefix(">"), words=not h.startswith(">")) if isinstance(h, str) else h
        for h in headings
    )
