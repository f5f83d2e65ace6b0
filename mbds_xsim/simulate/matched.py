"""Settings for a scene: the stored matched ones, those of a file, or an adapter's own presets."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.fingerprint import fingerprint
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, Profile, Settings


class Matched(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of one engine as they stand in a file, whatever frame interval they are used with.

    The figures that they gave, `found` in each table of the file, are for people.
    """

    method: str
    steps_per_frame: int
    options: dict[str, float | int | bool | str] = {}

    def settings(self, scene: Scene) -> Settings:
        """Give the settings for a scene."""
        return Settings(self.method, scene.clock.frame / self.steps_per_frame, self.options)


def settings_for(scene: Scene, adapter: Adapter, profile: Profile) -> Settings:
    """Give the settings without a search.

    `matched` settings that have been found and checked for a built-in scene are stored in
    `scenes/matched/`, one file a scene. They hold for its physics, whatever a scene is called.
    For other scenes the adapter makes a careful choice.
    """
    if profile == "matched" and is_stored(scene, adapter.name):
        return _stored(scene.name)[adapter.name].settings(scene)
    return adapter.settings(scene, profile)


def is_stored(scene: Scene, engine: str) -> bool:
    """Tell whether settings are stored for an engine and a scene of this physics."""
    return engine in _stored(scene.name) and _physics(scene) == _built_in(scene.name)


def read_matched(path: Path) -> dict[str, Matched]:
    """Read a file that `mbds-xsim match --out` wrote: settings by engine.

    Raises:
        InputError: The file cannot be read or is none of settings; the text says where.
    """
    try:
        found = _tables(path.read_text("utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        msg = f"--settings {path}: cannot be read: {error}"
        raise InputError(msg) from error
    except msgspec.ValidationError as error:
        msg = (
            f"--settings {path}: {error}; each engine has a table with `method`, "
            "`steps_per_frame` and, where need be, `options`, as `mbds-xsim match --out` writes it"
        )
        raise InputError(msg) from error
    for engine, entry in found.items():
        registry.load_adapter(engine)
        if entry.steps_per_frame < 1:
            msg = (
                f"--settings {path}: {engine}.steps_per_frame: got {entry.steps_per_frame}, "
                "allowed is 1 or more"
            )
            raise InputError(msg)
    if not found:
        msg = f"--settings {path}: no engine has settings there"
        raise InputError(msg)
    return found


@functools.cache
def _stored(scene_name: str) -> Mapping[str, Matched]:
    entry = files("mbds_xsim_scenes") / "matched" / f"{scene_name}.toml"
    return _tables(entry.read_text("utf-8")) if entry.is_file() else {}


def _tables(text: str) -> dict[str, Matched]:
    tables: Any = tomllib.loads(text)
    for table in tables.values():
        if isinstance(table, dict):
            table.pop("found", None)
    return msgspec.convert(tables, dict[str, Matched])


@functools.cache
def _built_in(scene_name: str) -> str:
    return _physics(registry.load_scene(scene_name))


def _physics(scene: Scene) -> str:
    """Stand for all that decides what settings a scene needs; how long it lasts does not."""
    return fingerprint(
        msgspec.structs.replace(scene, clock=msgspec.structs.replace(scene.clock, steps=1))
    )
