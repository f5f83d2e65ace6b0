"""Numbers in texts, and texts of scenes, files and engines made safe where they are shown.

Whatever a scene calls itself is data: it neither moves a terminal's cursor, nor becomes markup of
a page, nor a formula of a spreadsheet. HTML is escaped by its templates.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from collections.abc import Callable, Iterable
from typing import TypeVar, cast

import msgspec

_EXACT = 18
"""More digits than any number has that differs from another."""


def counted(number: int | None, one: str, several: str = "") -> str:
    """Write a number of things: `1 core`, `2 cores`, `15 000 trajectories`."""
    usual = (
        f"{one[:-1]}ies" if one.endswith("y") else f"{one}es" if one.endswith("s") else f"{one}s"
    )
    noun = one if number == 1 else several or usual
    return f"{number:,} {noun}".replace(",", " ") if number is not None else f"? {noun}"


def apart(
    figure: float, budget: float, write: Callable[[float, int], str], least: int
) -> tuple[str, str]:
    """Write a figure and its budget; one beyond it never reads as kept: `3.004` beside `3`.

    Args:
        figure: What was measured.
        budget: What is allowed.
        write: Writes a number with a number of digits.
        least: How many digits suffice elsewhere.
    """
    texts = ((write(figure, count), write(budget, count)) for count in range(least, _EXACT))
    pair = next(texts)
    while figure > budget and pair[0] == pair[1]:
        pair = next(texts)
    return pair


T = TypeVar("T")

# Control characters, C1 among them, and what reorders or hides text, but for line feed and tab.
_UNPRINTABLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    r"\U000e0000-\U000e007f]"
)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+](inf|nan)", re.IGNORECASE)
_ENTITIES = {ord(c): f"&#{ord(c)};" for c in "\\`*$|"} | {ord("<"): "&lt;"}
_LINK = re.compile(r"^\[|\](?= ?\[|[(:])")
_ENTITY = re.compile(r"&(?=#?\w+;)")
_BLOCK = re.compile(r"#+ |[+-] |>|[=~-]{3}")  # at the start of a paragraph
_COMMANDS = re.compile(r"(\w+_)?command")


def each_once(names: list[str] | None) -> list[str] | None:
    """Let what is named twice count once."""
    return names and list(dict.fromkeys(names))


def in_utf8(text: str) -> str:
    """Escape what cannot be written into a file: bytes of a file's name that are no UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode()


def printable(text: str) -> str:
    """Replace what a terminal would obey or hide by `�`."""
    return _UNPRINTABLE.sub("�", in_utf8(text))


def on_a_line(text: str) -> str:
    """Fold white space, and replace what a terminal would obey."""
    return printable(" ".join(text.split()))


def in_figure(text: str) -> str:
    """Keep matplotlib from reading formulas between dollar signs."""
    return on_a_line(text).replace("$", r"\$")


def in_json(text: str) -> str:
    """Escape in JSON what a terminal would obey; it means the same."""
    return _UNPRINTABLE.sub(lambda found: json.dumps(found[0])[1:-1], text)


def in_markdown(value: T) -> T:
    """Copy a text, or all texts of a result, for use in sentences and cells of Markdown.

    Fields that hold a command line are left as they are, for `as_code`.
    """
    return cast("T", _mapped(value))


def as_code(text: str) -> str:
    """Write a code span of Markdown."""
    line = on_a_line(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    return f"{fence}{line}{fence}" if fence == "`" else f"{fence} {line} {fence}"


def sentence(text: str) -> str:
    """Write a text as a sentence with a blank behind it; nothing for an empty one."""
    stop = "" if text.endswith((".", ":", "?", "!")) else "."
    return f"{text[0].upper()}{text[1:]}{stop} " if text else ""


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Write rows of cells; a text that a spreadsheet would compute gets an apostrophe before it."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([_cell(cell) for cell in row] for row in rows)
    return stream.getvalue()


def _cell(value: object) -> object:
    if not isinstance(value, str):
        return "" if value is None else value
    text = printable(value)
    formula = text.lstrip()[:1] in ("=", "+", "-", "@") and not _NUMBER.fullmatch(text)
    return f"'{text}" if formula else text


def _mapped(value: object) -> object:
    match value:
        case str():
            text = _ENTITY.sub("&amp;", on_a_line(value)).translate(_ENTITIES)
            text = _LINK.sub(lambda sign: f"&#{ord(sign[0])};", text)
            return f"&#{ord(text[0])};{text[1:]}" if _BLOCK.match(text) else text
        case tuple() | list():
            return type(value)(map(_mapped, value))
        case dict():
            return {_mapped(key): _mapped(item) for key, item in value.items()}
        case msgspec.Struct():
            return msgspec.structs.replace(value, **_fields(value, value.__struct_fields__))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return dataclasses.replace(value, **_fields(value, names))
    return value


def _fields(value: object, names: Iterable[str]) -> dict[str, object]:
    return {name: _mapped(getattr(value, name)) for name in names if not _COMMANDS.fullmatch(name)}
