"""Data files in a folder, by what they hold."""

from __future__ import annotations

from pathlib import Path

from mbds_xsim.dataset.facts import attributes_of
from mbds_xsim.dataset.layout import SUFFIX
from mbds_xsim.errors import InputError

__all__ = ["joined_files"]


def joined_files(path: Path, engines: str | None = None) -> list[Path]:
    """Give the data sets of a folder, or the one that a file is.

    Args:
        path: A data file, or a folder that `mbds-xsim generate` has made, or one within.
        engines: Only those of these, comma-separated.

    Raises:
        InputError: There are none.
    """
    if not path.exists():
        msg = f"{path}: there is no such file or folder"
        raise InputError(msg)
    kinds = {file: attributes_of(file) for file in _candidates(path)}
    found = [file for file, told in kinds.items() if path.is_file() or told["kind"] == "joined"]
    if not found:
        msg = f"{path} holds no data set; name a folder that mbds-xsim generate has finished"
        raise InputError(msg)
    if engines is None:
        return found
    wanted = [word.strip() for word in engines.split(",")]
    there = sorted({str(kinds[file].get("engine")) for file in found})
    strange = [word for word in wanted if word not in there]
    if strange:
        msg = f"--engines: got {strange[0]!r}, allowed for {path} is {', '.join(there)}"
        raise InputError(msg)
    return [file for file in found if kinds[file].get("engine") in wanted]


def _candidates(path: Path) -> list[Path]:
    """Files beside folders of their own name are joined; shards need not be opened."""
    if path.is_file():
        return [path]
    return [file for file in sorted(path.rglob(f"*{SUFFIX}")) if file.with_suffix("").is_dir()]
