"""Check the card and the metadata beside data: do they say what the data give."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mbds_xsim.dataset.additions import missing_lines
from mbds_xsim.dataset.card import CARD, CROISSANT, descriptions
from mbds_xsim.dataset.reaudit import FileReport
from mbds_xsim.errors import InputError
from mbds_xsim.registry import package_version

__all__ = ["described", "recheck_card", "recheck_metadata"]

_FILES = "distribution"
"""Entry of the metadata that lists files."""


def described(joined: list[Path]) -> list[Path]:
    """Cards and metadata beside some joined files."""
    folders = dict.fromkeys(path.parent for path in joined)
    return [
        folder / name
        for folder in folders
        for name in (CARD, CROISSANT)
        if (folder / name).is_file()
    ]


def recheck_card(path: Path) -> FileReport:
    """Find each line that the data give, in order; a publisher may have added others."""
    try:
        text, wanted = path.read_bytes().decode(), descriptions(path.parent)[CARD].decode()
    except (InputError, OSError, KeyError, ValueError, RuntimeError) as error:
        return FileReport(str(path), "card", 0, (f"cannot be compared: {error}",))
    differing = (
        f"does not say what the data give, first line {number}: {line[:100]!r}"
        for number, line in missing_lines(text, wanted)
    )
    return _report(path, "card", tuple(differing))


def recheck_metadata(path: Path) -> FileReport:
    """Find each entry that the data give; a publisher may have added others beside them."""
    try:
        found = json.loads(path.read_bytes())
        wanted = json.loads(descriptions(path.parent)[CROISSANT])
    except (InputError, OSError, KeyError, ValueError, RuntimeError) as error:
        return FileReport(str(path), "metadata", 0, (f"cannot be compared: {error}",))
    if not isinstance(found, dict):
        return FileReport(str(path), "metadata", 0, ("is no Croissant metadata",))
    return _report(path, "metadata", tuple(_other_entries(found, wanted)))


def _report(path: Path, kind: str, differing: tuple[str, ...]) -> FileReport:
    """Tell what differs; another version may word it otherwise, but not the files' checksums."""
    here = f"mbds-xsim {package_version('mbds-xsim')}"
    if not differing or here in descriptions(path.parent)[CARD].decode():
        return FileReport(str(path), kind, 0, differing)
    sure = tuple(each for each in differing if each.startswith(_FILES))
    note = f"{kind}: words not compared, for the data are not of {here}, which is here"
    return FileReport(str(path), kind, 0, sure, (note,))


def _other_entries(found: dict[str, Any], wanted: dict[str, Any]) -> Iterator[str]:
    for key, value in wanted.items():
        if key not in found:
            yield f"{key} is missing"
        elif key == _FILES and isinstance(found[key], list):
            yield from _other_files(found[key], value)
        elif found[key] != value:
            yield f"{key}: not what the data give"


def _other_files(found: list[Any], wanted: list[dict[str, Any]]) -> Iterator[str]:
    """Hold names, sizes and checksums of the files against the files."""
    for node in wanted:
        same = [each for each in found if isinstance(each, dict) and each.get("@id") == node["@id"]]
        if same == [node]:
            continue
        what = ", ".join(key for key in node if not same or same[0].get(key) != node[key])
        yield f"{_FILES}: {node['@id']}: {what}: not what the data give"
    if len(found) != len(wanted):
        yield f"{_FILES}: lists {len(found)} files, here are {len(wanted)}"
