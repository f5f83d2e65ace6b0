"""What a publisher added to a card or to metadata stays when they are written again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

__all__ = ["missing_lines", "with_additions"]


def with_additions(path: Path, content: bytes) -> bytes:
    """Give the new content of a card or of metadata, with what only a publisher can have added.

    Metadata keep the entries that the data do not give. A card that still says all that the data
    give stays as it is; where the data have changed it is written anew.
    """
    try:
        old = path.read_bytes()
        return _entries(old, content) if path.suffix == ".json" else _lines(old, content)
    except (OSError, ValueError):
        return content


def missing_lines(text: str, wanted: str) -> Iterator[tuple[int, str]]:
    """Give the first line, with its number, that a text does not have after those before it."""
    rest = iter(text.split("\n"))
    for number, line in enumerate(wanted.split("\n"), 1):
        if line not in rest:  # takes lines up to it
            yield number, line
            return


def _entries(old: bytes, content: bytes) -> bytes:
    found, ours = json.loads(old), json.loads(content)
    if not isinstance(found, dict) or found.keys() <= ours.keys():
        return content
    added = {key: value for key, value in found.items() if key not in ours}
    return (json.dumps(ours | added, indent=2, ensure_ascii=False) + "\n").encode()


def _lines(old: bytes, content: bytes) -> bytes:
    says_all = not any(missing_lines(old.decode(), content.decode()))
    return old if says_all else content
