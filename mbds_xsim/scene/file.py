"""Scene files: TOML to Scene and back, without loss.

Reading also assembles the mechanism and draws one trajectory of each interval, so that a scene
that was read can be simulated. `docs/scene-file.md` lists every key.
"""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w

from mbds_xsim.base import bounds
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.file_errors import explain
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import MOST_PARTS, Scene

_LINE = 100
_LARGEST_FILE = 16 * 10**6
_DEPTH = 100
_PARTS = re.compile(r"^[ \t]*+\[\[[ \t]*+(\w+)[ \t]*+\]\]", re.M)
_BARE = re.compile(r"(?<![\w-])[\w-]++(?:[ \t]*+\.[ \t]*+[\w-]++){9,}+")
_QUOTED = re.compile(r"[\"'][ \t]*+\.|\.[ \t]*+[\"']")


def read_scene(path: Path) -> Scene:
    """Read a scene file and check that its mechanism assembles and its starts can be drawn.

    Raises:
        SceneError: One line: the file, the table, what was got and what is allowed.
    """
    data = _load(path)
    try:
        scene = msgspec.convert(data, Scene)
        _check_starts(scene)
    except msgspec.ValidationError as error:
        raise SceneError(f"{path}: {explain(error, data)}") from error
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    except MemoryError as error:
        msg = f"{path}: out of memory with {scene.clock.steps} clock.steps: {error}; take fewer"
        raise SceneError(msg) from error
    return scene


def write_scene(scene: Scene, *, defaults: bool = False) -> str:
    """Give the text of a scene file; keys that have their default are mostly left out.

    With `defaults` they are all there: equal scenes then have equal texts, which mean the same to
    a version with other defaults.
    """
    return _compact(tomli_w.dumps(_explicit(scene) if defaults else msgspec.to_builtins(scene)))


def save_scene(scene: Scene, path: Path) -> None:
    """Write a scene file."""
    path.write_text(write_scene(scene), encoding="utf-8", newline="\n")


def _check_starts(scene: Scene) -> None:
    """Draw a trajectory of each interval; raise SceneError where a number runs out of range."""
    with np.errstate(all="ignore"):
        batch = draw_batch(scene, range(len(INTERVALS)))
    for key in ("position", "orientation", "velocity", "angular_velocity", "force", "torque"):
        if not np.isfinite(getattr(batch, key)).all():
            msg = f"a start's {key} is not finite: numbers are too large or too small; use SI units"
            raise SceneError(msg)


def _load(path: Path) -> Mapping[str, Any]:
    text = _text(path)
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise SceneError(f"{path}: this is not TOML: brackets without end") from error
    except ValueError as error:  # also from a number of too many digits
        raise SceneError(f"{path}: this is not TOML: {error}") from error


def _text(path: Path) -> str:
    """Read the text of a file that can be parsed in bounded time and memory."""
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_FILE + 1)
        text = content.decode("utf-8-sig")  # Windows writes a mark before the text
    except OSError as error:
        msg = (
            f"{path}: cannot be read ({error.strerror}); give the path of a .toml file or the "
            "name of a scene (mbds-xsim scenes lists them)"
        )
        raise SceneError(msg) from error
    except UnicodeDecodeError as error:
        msg = (
            f"{path}: got byte {error.object[error.start]:#04x} at {error.start}, allowed is UTF-8"
        )
        raise SceneError(msg) from error
    if len(content) > _LARGEST_FILE:
        size = f"{_LARGEST_FILE // 10**6} MB"
        raise SceneError(f"{path}: got more than {size}: 20 000 bodies with joints take 7 MB")
    for table, count in Counter(_PARTS.findall(text)).items():
        bounds.count(f"{path}: {table}", count, MOST_PARTS, "larger scenes are not tested")
    if _is_deep(text):
        msg = f"{path}: got a key of {_DEPTH} parts or more, the deepest of a scene has 4"
        raise SceneError(msg)
    return text


def _is_deep(text: str) -> bool:
    """Whether some key may have so many parts that parsing takes their square in memory.

    A dot between parts is in a run of bare parts or touches a quote; keys end with their line.
    """
    return any(match[0].count(".") >= _DEPTH - 1 for match in _BARE.finditer(text)) or any(
        len(_QUOTED.findall(line)) >= _DEPTH - 1 for line in text.splitlines()
    )


def _explicit(value: Any) -> Any:
    """Plain values of a scene, with all keys but those that say nothing."""
    if isinstance(value, tuple):
        return [_explicit(item) for item in value]
    if not isinstance(value, msgspec.Struct):
        return value
    config = value.__struct_config__
    tag = {config.tag_field: config.tag} if config.tag_field else {}
    fields = {key: getattr(value, key) for key in value.__struct_fields__}
    return tag | {key: _explicit(item) for key, item in fields.items() if item is not None}


def _compact(text: str) -> str:
    """Put arrays that fit into one line, which the writer spreads over one line a number."""
    lines: list[str] = []
    opened: list[int] = []
    for line in text.removesuffix("\n").split("\n"):
        lines.append(line)
        # Strings end in a quote, so only an array that goes on ends in a bracket like this.
        if line.endswith("["):
            opened.append(len(lines) - 1)
        elif line.strip() in ("]", "],"):
            first = opened.pop()
            inner = " ".join(item.strip() for item in lines[first + 1 : -1]).removesuffix(",")
            joined = lines[first] + inner + line.strip()
            if len(joined) <= _LINE:
                lines[first:] = [joined]
    return "\n".join(lines) + "\n"
