"""Which engines run at which settings, from the user's words.

Settings are the stored matched ones, those of a file, or an adapter's own presets.
"""

from __future__ import annotations

import functools
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError, UnknownName, Unsupported
from mbds_xsim.base.files import read_file
from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import fingerprint
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, Profile, Settings


@dataclass(frozen=True)
class Contender:
    """One row of the table to be."""

    engine: str
    profile: Profile
    settings: Settings
    limit: float = field(default=LIMIT, compare=False)
    """Longest that one piece of its work may take [s]."""

    @property
    def name(self) -> str:
        """Engine and profile."""
        return f"{self.engine} ({self.profile})"


@dataclass(frozen=True)
class Choice:
    """Which engines at which settings."""

    engines: tuple[str, ...]
    profiles: tuple[Profile, ...] = ("matched",)
    method: str | None = None
    step: float | None = None
    named: bool = True
    """Whether the engines were asked for by name: one that cannot do the scene is then an error;
    otherwise it is left out, and the result says so."""
    given: Mapping[str, Matched] = field(default_factory=dict, hash=False)
    """Matched settings by engine, from a file or a search, that go before those stored."""
    limit: float = LIMIT
    """Longest that one piece of an engine's work may take [s]."""

    @staticmethod
    def parse(
        *,
        engines: str | Iterable[str] | None = None,
        profiles: str | Iterable[str] = "matched",
        method: str | None = None,
        step: float | None = None,
        limit: float = LIMIT,
        also: tuple[str, ...] = (),
    ) -> Choice:
        """Read names, or words separated by commas; no engine named means all installed.

        What is beside these, `also`, then takes part too.

        A profile may be the path of a file of settings, as `mbds-xsim match --out` writes it:
        settings that are matched for a scene; no engine named means all of the file then.
        """
        names = words_of(engines) if engines is not None else ()
        for name in names:
            registry.load_adapter(name)
        named = bool(names)
        words, given = _profiles(words_of(profiles), names)
        names = names or tuple(given) or (*registry.installed_engines(), *also)
        if not names:
            msg = "no engine is installed; install them with: pip install 'mbds-xsim[engines]'"
            raise InputError(msg)
        if method is not None and len(names) != 1:
            msg = f"--method {method}: methods differ between engines, name one with --engines"
            raise InputError(msg)
        return Choice(names, words, method, step, named, given, limit)

    def contenders(self, scene: Scene) -> tuple[list[Contender], dict[str, str]]:
        """Settle the settings of every engine.

        Returns:
            The contenders, and the engines left out, each with the reason.

        Raises:
            Unsupported: An engine asked for by name cannot do the scene, or none can.
            InputError: The settings are wrong.
        """
        found: list[Contender] = []
        left_out: dict[str, str] = {}
        for profile in self.profiles:
            for name in self.engines:
                adapter = registry.load_adapter(name)
                try:
                    settings = self._settings(scene, adapter, profile)
                    adapter.check(scene, settings)
                except Unsupported as error:
                    left_out[name] = str(error)
                else:
                    found.append(Contender(name, profile, settings, self.limit))
        if left_out and (self.named or not found):
            raise Unsupported(self._refusal(scene, left_out))
        return found, left_out | self.faulty

    @property
    def faulty(self) -> dict[str, str]:
        """Adapters that would take part but cannot be used, each with the reason."""
        return {} if self.named or self.given else registry.faulty_engines()

    def _settings(self, scene: Scene, adapter: Adapter, profile: Profile) -> Settings:
        preset = (
            self.given[adapter.name].settings(scene)
            if profile == "matched" and adapter.name in self.given
            else settings_for(scene, adapter, profile)
        )
        method = self.method or preset.method
        if self.step is not None and method in adapter.methods and adapter.methods[method].adaptive:
            msg = f"--step: {adapter.name} {method} chooses its steps; leave it out"
            raise InputError(msg)
        return Settings(
            method,
            preset.step if self.step is None else self.step,
            preset.options if self.method in (None, preset.method) else {},
        )

    def _refusal(self, scene: Scene, left_out: dict[str, str]) -> str:
        """Say what cannot be done, and what can do it."""
        name, reason = next(iter(left_out.items()))
        methods = _able_methods(registry.load_adapter(name), scene)
        able = [e for e in self.engines if _able_methods(registry.load_adapter(e), scene)]
        hint = f"use --method {' or '.join(methods)}" if methods else "no engine given here can"
        if able and not methods:
            hint = f"use --engines {','.join(able)}"
        return f"{reason}; {hint}"


def is_file(word: str) -> bool:
    """Tell whether a word for settings names a file, and no profile."""
    return bool(Path(word).suffix) or os.sep in word


def _profiles(
    words: tuple[str, ...], engines: tuple[str, ...]
) -> tuple[tuple[Profile, ...], dict[str, Matched]]:
    """Tell profiles from files of settings, and read these."""
    paths = [word for word in words if is_file(word)]
    if not words or len(paths) > 1 or (paths and "matched" in words):
        msg = f"--settings: got {','.join(words) or 'none'}, allowed is one of matched and a file"
        raise InputError(msg)
    given = read_matched(Path(paths[0])) if paths else {}
    missing = [name for name in engines if given and name not in given]
    if missing:
        msg = f"--settings {paths[0]}: no settings of {missing[0]}; there are: {', '.join(given)}"
        raise InputError(msg)
    return tuple("matched" if word in paths else as_profile(word) for word in words), given


def _able_methods(adapter: Adapter, scene: Scene) -> list[str]:
    if adapter.cannot_hold(scene):
        return []
    return [name for name in adapter.methods if not adapter.refusals(scene, name)]


def words_of(given: str | Iterable[str]) -> tuple[str, ...]:
    """Split a text at commas; each word counts once.

    Raises:
        InputError: It is neither a text nor several.
    """
    words = given.split(",") if isinstance(given, str) else given
    if not isinstance(words, Iterable) or not all(isinstance(word, str) for word in words):
        msg = f"got {given!r}, allowed are names, as 'one,other' or ['one', 'other']"
        raise InputError(msg)
    return tuple(dict.fromkeys(word.strip() for word in words))


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
    `scenes/matched/`, one file a scene; those of an engine that another package adds, in the folder
    that this package registers. They hold for its physics, whatever a scene is called.
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
        found = _tables(read_file(path).decode("utf-8-sig"))
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
    """Read the toolkit's, and each engine's that its own package ships."""
    entry = files("mbds_xsim_scenes") / "matched" / f"{scene_name}.toml"
    found = _tables(entry.read_text("utf-8")) if entry.is_file() else {}
    for engine, point in registry.registered("mbds_xsim.matched").items():
        package = find_spec(point.value)  # which imports nothing
        for folder in (package and package.submodule_search_locations) or ():
            theirs = Path(folder) / f"{scene_name}.toml"
            if engine not in found and theirs.is_file():
                found |= {name: e for name, e in read_matched(theirs).items() if name == engine}
    return found


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


def as_profile(name: str) -> Profile:
    """Read a profile's name."""
    profiles: dict[str, Profile] = {"matched": "matched", "native": "native"}
    if name not in profiles:
        raise UnknownName.of("settings profile", name, sorted(profiles))
    return profiles[name]
