"""Scene files: TOML to Scene and back, without loss.

Reading also assembles the mechanism and draws one trajectory of each interval, so that every
scene that is read can be simulated. `docs/scene-file.md` lists every key.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w
from msgspec import inspect

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import InputError, SceneError
from mbds_xsim.base.files import check_ending, path_of, read_bounded, write_whole
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import MOST_PARTS, Scene

_Path = list[Any]  # keys and positions

_LINE = 100
_LARGEST_FILE = 16 * 10**6
_DEPTH = 100
_PARTS = re.compile(r"^[ \t]*+\[\[[ \t]*+(\w+)[ \t]*+\]\]", re.M)
_BARE = re.compile(r"(?<![\w-])[\w-]++(?:[ \t]*+\.[ \t]*+[\w-]++){9,}+")
_QUOTED = re.compile(r"[\"'][ \t]*+\.|\.[ \t]*+[\"']")
_STEP = re.compile(r"(\w+)|\[(\d+)\]")
_FIELD = re.compile(
    r"Object (?P<fault>contains unknown|missing required) field `(?P<key>.*?)`", re.DOTALL
)
_LEADING_KEY = re.compile(r"(\w+): ")


def read_scene(path: Path) -> Scene:
    """Read a scene file and check that its mechanism assembles and its starts can be drawn.

    Raises:
        SceneError: With one line: the file, the table, the value found and what is allowed.
    """
    data = _load(path)
    try:
        scene = msgspec.convert(data, Scene)
        check_starts(scene)
    except msgspec.ValidationError as error:
        raise SceneError(f"{path}: {explain(error, data)}") from error
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    except MemoryError as error:
        msg = f"{path}: out of memory with {scene.clock.steps} clock.steps: {error}; take fewer"
        raise SceneError(msg) from error
    return scene


def write_scene(scene: Scene, *, defaults: bool = False) -> str:
    """Return the text of a scene file; keys with default values are mostly left out.

    With `defaults`, all are written: equal scenes then have equal texts, which keep their meaning
    in a version with other defaults.
    """
    return _compact(tomli_w.dumps(_explicit(scene) if defaults else msgspec.to_builtins(scene)))


def save_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene file atomically.

    Raises:
        InputError: The file cannot be written, or an argument is something else.
    """
    if not isinstance(scene, Scene):
        raise InputError(f"scene: got {scene!r:.60}, allowed is a Scene, as load_scene returns it")
    check_ending(path := path_of("path", path), "path")
    write_whole(path, write_scene(scene).encode())


def check_starts(scene: Scene) -> None:
    """Draw one trajectory per interval; raise SceneError if a number is not finite."""
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
        raise SceneError(f"{path}: this is not TOML: brackets nested too deeply") from error
    except ValueError as error:  # also raised for a number with too many digits
        raise SceneError(f"{path}: this is not TOML: {error}") from error


def _text(path: Path) -> str:
    """Read the text of a file that can be parsed in bounded time and memory."""
    try:
        remark = ": 20 000 bodies with joints take 7 MB"
        content = read_bounded(path, _LARGEST_FILE, remark, SceneError)
        text = content.decode("utf-8-sig")  # Windows may add a byte order mark
    except OSError as error:
        raise SceneError(
            f"{path}: cannot be read ({error.strerror}); give the path of a .toml file or the "
            "name of a scene (mbds-xsim scenes lists them)"
        ) from error
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{path}: got byte {error.object[error.start]:#04x} at {error.start}, allowed is UTF-8"
        ) from error
    for table, count in Counter(_PARTS.findall(text)).items():
        bounds.count(f"{path}: {table}", count, MOST_PARTS, "larger scenes are not tested")
    if _is_deep(text):
        msg = f"{path}: got a key of {_DEPTH} parts or more, the deepest of a scene has 4"
        raise SceneError(msg)
    return text


def _is_deep(text: str) -> bool:
    """Return whether a key may have so many parts that parsing takes quadratic memory.

    A dot between parts is in a run of bare parts or touches a quote; keys end with their line.
    """
    return any(match[0].count(".") >= _DEPTH - 1 for match in _BARE.finditer(text)) or any(
        len(_QUOTED.findall(line)) >= _DEPTH - 1 for line in text.splitlines()
    )


def _explicit(value: Any) -> Any:
    """Return a scene as plain values, without keys that have no effect."""
    if isinstance(value, tuple):
        return [_explicit(item) for item in value]
    if not isinstance(value, Neutral):
        return value
    config = value.__struct_config__
    tag = {config.tag_field: config.tag} if config.tag_field else {}
    fields = value.decisive().items()
    return tag | {key: _explicit(item) for key, item in fields if item is not None}


def _compact(text: str) -> str:
    """Join arrays that fit on one line; the writer puts every number on its own line."""
    lines: list[str] = []
    starts: list[int] = []
    for line in text.removesuffix("\n").split("\n"):
        lines.append(line)
        # Strings end in a quote, so only the start of a multi-line array ends in a bracket.
        if line.endswith("["):
            starts.append(len(lines) - 1)
        elif line.strip() in ("]", "],"):
            first = starts.pop()
            inner = " ".join(item.strip() for item in lines[first + 1 : -1]).removesuffix(",")
            joined = lines[first] + inner + line.strip()
            if len(joined) <= _LINE:
                lines[first:] = [joined]
    return "\n".join(lines) + "\n"


def explain(error: msgspec.ValidationError, data: Mapping[str, Any]) -> str:
    """Explain a failed conversion of `data` to Scene in the user's terms."""
    text = str(error)
    _, _, place = text.partition(" - at `$")
    path: _Path = [name or int(number) for name, number in _STEP.findall(place)]
    cause = error.__cause__
    if isinstance(cause, SceneError):
        return _explain_value(str(cause), path, data)
    if field := _FIELD.match(text):
        return _explain_key(field["fault"] == "contains unknown", field["key"], path, data)
    value, kind = _descend(path, data)
    allowed = (isinstance(value, str) and _tags(kind)) or _allowed(kind)
    return f"{_where(path, data)}got {_text_of(value)}, allowed is {allowed}"


def _explain_value(text: str, path: _Path, data: Mapping[str, Any]) -> str:
    """Explain values that a struct refused; its text starts with one of its keys or is complete."""
    _, kind = _descend(path, data)
    key = _LEADING_KEY.match(text)
    if key and path and isinstance(kind, inspect.StructType) and key[1] in _keys(kind):
        return _where([*path, key[1]], data) + text[key.end() :]
    return _where(path, data) + text


def _explain_key(unknown: bool, key: str, path: _Path, data: Mapping[str, Any]) -> str:
    table, kind = _descend(path, data)
    where = _where(path, data)
    if not isinstance(kind, inspect.StructType):
        return f"{where}the key 'kind' is missing; allowed is {_allowed(kind)}"
    keys = _keys(kind)
    if unknown:
        matches = difflib.get_close_matches(key, keys, n=1)
        hint = f"; did you mean {matches[0]!r}? Allowed are " if matches else "; allowed are "
        return f"{where}unknown key {key!r}{hint}{', '.join(keys)}"
    present = ", ".join(map(str, table)) or "none"
    return f"{where}the key {key!r} is missing, it is {_allowed(keys[key])}; got {present}"


def _keys(kind: inspect.StructType) -> dict[str, inspect.Type]:
    keys = {field.encode_name: field.type for field in kind.fields}
    return {kind.tag_field: inspect.StrType(), **keys} if kind.tag_field else keys


def _descend(path: _Path, data: Any) -> tuple[Any, inspect.Type]:
    """Return value and type at a path, down to which the data is known to be valid."""
    value, kind = data, inspect.type_info(Scene)
    for step in path:
        kind = _resolved(kind, value)
        if isinstance(kind, inspect.StructType):
            kind = _keys(kind)[str(step)]
        elif isinstance(kind, inspect.TupleType):
            kind = kind.item_types[int(step)]
        elif isinstance(kind, inspect.VarTupleType):
            kind = kind.item_type
        value = value[step]
    return value, _resolved(kind, value)


def _resolved(kind: inspect.Type, value: Any) -> inspect.Type:
    """Return the union member as which the value was read."""
    if not isinstance(kind, inspect.UnionType):
        return kind
    tables = [t for t in kind.types if isinstance(t, inspect.StructType)]
    if isinstance(value, Mapping):
        tagged = [t for t in tables if t.tag is None or t.tag == value.get(t.tag_field or "")]
        return tagged[0] if len(tagged) == 1 else kind
    others = [t for t in kind.types if t not in tables and not isinstance(t, inspect.NoneType)]
    wanted = isinstance(value, list) or not tables
    return others[0] if wanted and len(others) == 1 else kind


def _where(path: _Path, data: Mapping[str, Any]) -> str:
    """Format a path as in `bodies[2].particles[0].mass (in 'rung1'): `."""
    if not path:
        return ""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    table = data.get(path[0])
    item = table[path[1]] if isinstance(table, list) and path[1:] else None
    name = item.get("name") if isinstance(item, dict) else None
    named = f" (in {name!r})" if isinstance(name, str) and path[2:] != ["name"] else ""
    return f"{text.removeprefix('.')}{named}: "


def _text_of(value: Any) -> str:
    text = "a table" if isinstance(value, Mapping) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _allowed(kind: inspect.Type) -> str:
    match kind:
        case inspect.FloatType():
            return "a number"
        case inspect.IntType():
            return "a whole number"
        case inspect.StrType():
            return "a text"
        case inspect.BoolType():
            return "true or false"
        case inspect.LiteralType():
            return " or ".join(repr(value) for value in kind.values)
        case inspect.TupleType():
            return _counted(kind)
        case inspect.VarTupleType():
            return f"an array, each item {_allowed(kind.item_type)}"
        case inspect.StructType():
            tag = f" with {kind.tag_field} = {kind.tag!r}" if kind.tag_field else ""
            return f"a table{tag} of {', '.join(f.encode_name for f in kind.fields)}"
        case inspect.UnionType():
            if tags := _tags(kind):
                return f"a table with kind = {tags}"
            members = (t for t in kind.types if not isinstance(t, inspect.NoneType))
            return " or ".join(map(_allowed, members))
        case _:
            return str(kind)


def _counted(kind: inspect.TupleType) -> str:
    items = {_allowed(item) for item in kind.item_types}
    each = items.pop() if len(items) == 1 else "as documented"
    plural = {"a number": "numbers", "a whole number": "whole numbers", "a text": "texts"}
    count = len(kind.item_types)
    return f"an array of {count} {plural.get(each, f'items, each {each}')}"


def _tags(kind: inspect.Type) -> str:
    """List the tags of a tagged union of tables."""
    members = kind.types if isinstance(kind, inspect.UnionType) else ()
    tagged = [t for t in members if isinstance(t, inspect.StructType) and t.tag_field]
    return " or ".join(repr(t.tag) for t in tagged)
