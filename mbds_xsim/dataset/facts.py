"""What a data file says of itself: its attributes, held against the layout, and its scene."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.dataset.layout import ATTRIBUTES, FORMAT, SHARED, VERSION, Kind
from mbds_xsim.dataset.opened import opened
from mbds_xsim.errors import InputError
from mbds_xsim.scene import Scene

__all__ = ["attributes_of", "scene_of"]

_JOINT = (*SHARED, "kind", "count")
_ALLOWED: dict[Kind, tuple[str, Callable[[Any], bool]]] = {
    "text": ("text", lambda got: isinstance(got, str)),
    "truth": ("true or false", lambda got: isinstance(got, bool)),
    "natural": (
        "a whole number from 0",
        lambda got: isinstance(got, int) and not isinstance(got, bool) and got >= 0,
    ),
    "number": (
        "a finite number",
        lambda got: isinstance(got, int | float) and math.isfinite(got),
    ),
    "positive": (
        "a positive number",
        lambda got: isinstance(got, int | float) and math.isfinite(got) and got > 0,
    ),
}


def attributes_of(path: Path) -> dict[str, Any]:
    """Attributes of a data file.

    Raises:
        InputError: It is no data file, of a newer layout, or an attribute is missing or wrong.
    """
    with opened(path) as file:
        found = {key: _plain(value) for key, value in file.attrs.items()}
    if not _is(found.get("format"), FORMAT):
        msg = f"{path} is HDF5, but no {FORMAT} file: its attribute 'format' does not say so"
        raise InputError(msg)
    if not isinstance(found.get("layout_version"), int) or found["layout_version"] > VERSION:
        msg = (
            f"{path} has layout version {found.get('layout_version')}, this program reads up to "
            f"{VERSION}; install a newer mbds-xsim"
        )
        raise InputError(msg)
    wanted = [key for key in ATTRIBUTES if key in _JOINT or not _is(found.get("kind"), "joint")]
    for key in wanted:
        words, fits = _ALLOWED[ATTRIBUTES[key]]
        if not fits(found.get(key)):
            got = repr(found[key])[:60] if key in found else "none"
            msg = f"{path}: attribute {key}: got {got}, allowed is {words}; get the file again"
            raise InputError(msg)
    return found


def scene_of(text: Any, path: Path, advice: str = "get the file again") -> Scene:
    """Read the scene that a file has as text.

    Raises:
        InputError: It is none.
    """
    try:
        return msgspec.convert(tomllib.loads(text), Scene)
    # The last are what the parser has for text that is none, numbers and brackets without end.
    except (msgspec.ValidationError, TypeError, ValueError, RecursionError) as error:
        msg = f"{path}: its attribute scene is no scene: {error}; {advice}"
        raise InputError(msg) from error


def _is(got: Any, wanted: str) -> bool:
    return isinstance(got, str) and got == wanted


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
