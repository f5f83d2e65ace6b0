"""Which shards are still to be made, and whether they may be put where they are to go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mbds_xsim.dataset.facts import attributes_of
from mbds_xsim.dataset.layout import SHARED, SUFFIX
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.errors import InputError

__all__ = ["check_paired", "pending"]


def pending(variant: Variant, trajectories: int, out: Path) -> list[Item]:
    """Shards that are not there yet.

    Raises:
        InputError: The folder holds something else than the beginning of this data.
    """
    folder = variant.folder(out)
    items = list(variant.items(trajectories))
    there = {path.name for path in folder.glob(f"*{SUFFIX}")}
    beyond = sorted(there - {item.file_name for item in items})
    if beyond:
        msg = (
            f"{folder} holds {beyond[0]}, which {trajectories} trajectories do not have; ask for "
            "as many as before, or name another --out"
        )
        raise InputError(msg)
    return [
        item
        for item in items
        if item.file_name not in there or not _is_complete(variant, item, folder)
    ]


def check_paired(variant: Variant, out: Path) -> None:
    """Raise InputError where another variant in the folder has other starts."""
    folder = variant.folder(out).parent
    others = {path.parent: path for path in folder.glob(f"*/*{SUFFIX}")}
    for path in others.values():
        found = _attributes(path)
        for key in SHARED:
            if found.get(key) != variant.recipe[key]:
                msg = (
                    f"{folder} holds trajectories that cannot be paired with those asked for: "
                    f"{_difference(key, found.get(key), variant.recipe[key])}; name another --out"
                )
                raise InputError(msg)


def _is_complete(variant: Variant, item: Item, folder: Path) -> bool:
    """Whether a file is this shard; a shorter one, of a smaller set, is made anew."""
    path = folder / item.file_name
    found = _attributes(path)
    for key, wanted in variant.recipe.items():
        if found.get(key) != wanted:
            msg = (
                f"{path} was made otherwise: {_difference(key, found.get(key), wanted)}; name "
                "another --out"
            )
            raise InputError(msg)
    if found.get("count", 0) > item.count:
        msg = f"{path} holds more trajectories than asked for; ask for as many as before"
        raise InputError(msg)
    return bool(found["count"] == item.count)


def _attributes(path: Path) -> dict[str, Any]:
    try:
        return attributes_of(path)
    except InputError as error:
        msg = f"{error}; delete it to have it made anew, or name another --out"
        raise InputError(msg) from error


def _difference(key: str, got: Any, wanted: Any) -> str:
    if isinstance(wanted, str) and "\n" in wanted:
        return f"its {key} differs from the one given"
    return f"its {key} is {got!r}, now asked for is {wanted!r}"
