"""Numbers written as text, and safe display of texts from scenes, files and engines.

Such texts are data: they must not move a terminal's cursor, nor become markup of a page or a
formula of a spreadsheet. HTML is escaped by its templates.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable
from typing import TypeVar, cast

import msgspec

_EXACT = 18
"""One more than the digits that distinguish any two double-precision numbers."""


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
    """Write a figure and its budget; a figure above it never reads the same: `3.004` and `3`.

    Args:
        figure: Measured value.
        budget: Largest allowed value.
        write: Function that writes a number with a given number of digits.
        least: Number of digits to start with.
    """
    texts = ((write(figure, count), write(budget, count)) for count in range(least, _EXACT))
    pair = next(texts)
    while figure > budget and pair[0] == pair[1]:
        pair = next(texts)
    return pair


T = TypeVar("T")

# Control characters (also C1, but not line feed and tab) and characters that reorder or hide text.
_UNPRINTABLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    r"\U000e0000-\U000e007f]"
)
_BEYOND_ASCII = re.compile(r"[^\n -~]")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+](inf|nan)", re.IGNORECASE)
_ENTITIES = {ord(c): f"&#{ord(c)};" for c in "\\`*$|"} | {ord("<"): "&lt;"}
_LINK = re.compile(r"^\[|\](?= ?\[|[(:])")
_ENTITY = re.compile(r"&(?=#?\w+;)")
_EMPHASIS = re.compile(r"(?<!\w)_+|(?<!_)_++(?!\w)")  # within a word it is itself
_BLOCK = re.compile(r"#+ |[+-] |>|[=~-]{3}|\d+[.)]( |$)")  # at the start of a paragraph
_COMMANDS = re.compile(r"(\w+_)?command")


def each_once(names: list[str] | None) -> list[str] | None:
    """Remove repeated names, keeping the order."""
    return names and list(dict.fromkeys(names))


def in_utf8(text: str) -> str:
    """Escape characters that UTF-8 cannot encode, such as odd bytes of a file name."""
    return text.encode("utf-8", "backslashreplace").decode()


def all_in_utf8(value: object) -> object:
    """Escape what UTF-8 cannot encode in all texts of plain lists and dictionaries, keys too."""
    match value:
        case str():
            return in_utf8(value)
        case list() | tuple():
            return [all_in_utf8(item) for item in value]
        case dict():
            return {all_in_utf8(key): all_in_utf8(item) for key, item in value.items()}
    return value


def encoded(value: object, command: str = "") -> bytes:
    """Return indented JSON, NaN as null; a result without a schema gets that of its command."""
    plain = msgspec.to_builtins(value)
    schema = {"schema": f"mbds-xsim/{command}/1"} if command else {}
    plain = [schema | item for item in plain] if isinstance(plain, list) else schema | plain
    return msgspec.json.format(msgspec.json.encode(all_in_utf8(plain)), indent=2)


def printable(text: str) -> str:
    """Replace characters that a terminal would obey or hide by `�`."""
    return _UNPRINTABLE.sub("�", in_utf8(text))


def on_a_line(text: str) -> str:
    """Fold white space, and replace characters that a terminal would obey or hide."""
    return printable(" ".join(text.split()))


def in_figure(text: str) -> str:
    """Keep matplotlib from reading formulas between dollar signs."""
    return on_a_line(text).replace("$", r"\$")


def in_json(text: str) -> str:
    """Escape characters of JSON that a terminal would obey, or that it may encode otherwise."""
    return _BEYOND_ASCII.sub(lambda match: json.dumps(match[0])[1:-1], text)


def in_markdown(value: T) -> T:
    """Copy a text, or all texts of a result, for use in sentences and cells of Markdown.

    Fields that hold a command line are left as they are, for `as_code`.
    """
    return cast("T", _mapped(value))


def in_alt_text(text: str) -> str:
    """Write the description of a picture of Markdown, which brackets would end."""
    return in_markdown(text).replace("[", "&#91;").replace("]", "&#93;")


def as_code(text: str) -> str:
    """Write a code span of Markdown."""
    line = on_a_line(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    return f"{fence}{line}{fence}" if fence == "`" else f"{fence} {line} {fence}"


def sentence(text: str) -> str:
    """Write a text as a sentence followed by a space; an empty text stays empty."""
    stop = "" if text.endswith((".", ":", "?", "!")) else "."
    return f"{text[0].upper()}{text[1:]}{stop} " if text else ""


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Write rows of cells as CSV; put an apostrophe before text a spreadsheet would compute."""
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
            text = _EMPHASIS.sub(_as_entities, _LINK.sub(_as_entities, text))
            return f"&#{ord(text[0])};{text[1:]}" if _BLOCK.match(text) else text
        case tuple() | list():
            return type(value)(map(_mapped, value))
        case dict():
            return {_mapped(key): _mapped(item) for key, item in value.items()}
        case msgspec.Struct():
            fields = msgspec.structs.asdict(value).items()
            told = {key: _mapped(item) for key, item in fields if not _COMMANDS.fullmatch(key)}
            return msgspec.structs.replace(value, **told)
    return value


def _as_entities(signs: re.Match[str]) -> str:
    return "".join(f"&#{ord(sign)};" for sign in signs[0])
