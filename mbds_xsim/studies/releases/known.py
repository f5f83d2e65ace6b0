"""What is known of engines' releases: where to begin, and lines of their change logs."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from importlib.resources import files

import msgspec


class LogLine(msgspec.Struct, frozen=True):
    """What a change log says of some rows."""

    release: str
    rows: str
    """Regular expression that is looked for in a row's name and figure."""
    line: str


class KnownReleases(msgspec.Struct, frozen=True):
    """What is known of an engine's releases."""

    since: str = ""
    """The first that is measured where no other is asked for."""
    source: str = ""
    """Address of the change log."""
    lines: tuple[LogLine, ...] = ()

    def explanation(self, release: str, row: str) -> str:
        """Give what the change log says of a row in a release; empty: nothing is known."""
        found = (e.line for e in self.lines if e.release == release and re.search(e.rows, row))
        return next(found, "")


def known_of(engine: str) -> KnownReleases:
    """Give what is known of an engine."""
    return _known().get(engine, KnownReleases())


@cache
def _known() -> dict[str, KnownReleases]:
    text = (files(__package__ or "") / "changes.toml").read_text("utf-8")
    return msgspec.convert(tomllib.loads(text), dict[str, KnownReleases])
