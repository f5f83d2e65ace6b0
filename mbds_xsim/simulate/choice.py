"""Engines and their settings, as chosen by the user's words.

Settings are the stored matched ones, an adapter's own presets, or those of files; each has a name,
its *profile*.
"""

from __future__ import annotations

import functools
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError, Unsupported, check_name
from mbds_xsim.base.files import read_file
from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import fingerprint
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import MOST_STEPS, Adapter, Profile, Settings

MATCHED, _NATIVE = "matched", "native"
_NAME = re.compile("[a-z][a-z0-9_]{0,39}")  # no "-", which ends the engine in file names


@dataclass(frozen=True)
class Contender:
    """An engine at a profile of settings: a future row of the table."""

    engine: str
    profile: str
    """Name of its settings: matched, native, or the name of those in a file."""
    settings: Settings
    limit: float = field(default=LIMIT, compare=False)
    """Time limit of one piece of its work [s]."""

    @property
    def name(self) -> str:
        """Name made of engine and profile."""
        return f"{self.engine} ({self.profile})"


@dataclass(frozen=True)
class Choice:
    """Engines and profiles of settings to run."""

    engines: tuple[str, ...]
    profiles: tuple[str, ...] = (MATCHED,)
    method: str | None = None
    step: float | None = None
    named: bool = True
    """Whether the engines were asked for by name: one that cannot simulate the scene is then an
    error; otherwise it is left out, and the result says so."""
    settings: Mapping[str, Mapping[str, Matched]] = field(default_factory=dict, hash=False)
    """Settings by profile and engine, from files or a search, preferred to stored ones."""
    limit: float = LIMIT
    """Time limit of one piece of an engine's work [s]."""
    every: bool = False
    """Whether all installed engines take part, so that those that cannot be used are missing."""

    @staticmethod
    def parse(
        *,
        engines: str | Iterable[str] | None = None,
        profiles: str | Path | Iterable[str | Path] = MATCHED,
        method: str | None = None,
        step: float | None = None,
        limit: float = LIMIT,
        also: tuple[str, ...] = (),
    ) -> Choice:
        """Read names, given one by one or separated by commas.

        If no engine is named, all engines of the settings files take part or, without such files,
        all installed engines and those in `also`. A profile may be the path of a settings file: as
        `mbds-xsim match --out` writes it, or with a `name` of its own.
        """
        names = words_of(engines, "--engines") if engines is not None else ()
        for name in names:
            registry.load_adapter(name)
        named = bool(names)
        words, settings = _profiles(words_of(profiles, "--settings"), names)
        listed = dict.fromkeys(name for table in settings.values() for name in table)
        names = names or tuple(listed) or (*registry.installed_engines(), *also)
        if not names:
            msg = "no engine is installed; install them with: pip install 'mbds-xsim[engines]'"
            raise InputError(msg)
        if method is not None and len(names) != 1:
            msg = f"--method {method}: methods differ between engines, name one with --engines"
            raise InputError(msg)
        every = not named and not settings
        return Choice(names, words, method, step, named, settings, limit, every)

    def contenders(self, scene: Scene) -> tuple[list[Contender], dict[str, str]]:
        """Determine the settings of every engine.

        Returns:
            The contenders, and the engines left out, each with the reason.

        Raises:
            Unsupported: An engine asked for by name cannot simulate the scene, or none can.
            InputError: The settings are wrong.
        """
        contenders: list[Contender] = []
        left_out: dict[str, str] = {}
        without = set[str]()  # engines without settings, whatever the method
        for profile in self.profiles:
            for name in self.engines:
                if profile != MATCHED and name not in self.settings.get(profile, {name: None}):
                    continue
                adapter = registry.load_adapter(name)
                settings = None
                try:
                    settings = self._settings(scene, adapter, profile)
                    adapter.check(scene, settings)
                except Unsupported as error:
                    left_out[name] = str(error)
                    without |= set() if settings else {name}
                else:
                    contenders.append(Contender(name, profile, settings, self.limit))
        if left_out and (self.named or not contenders):
            raise Unsupported(self._refusal(scene, left_out, without))
        return contenders, left_out | self.faulty

    @property
    def faulty(self) -> dict[str, str]:
        """Adapters that would take part but cannot be used, each with the reason."""
        return registry.faulty_engines() if self.every else {}

    def _settings(self, scene: Scene, adapter: Adapter, profile: str) -> Settings:
        matched = self.settings.get(profile, {}).get(adapter.name)
        preset = matched and matched.settings(scene)
        preset = preset or settings_for(scene, adapter, as_profile(profile))
        method = self.method or preset.method
        step = preset.step if self.step is None else self.step
        if method in adapter.methods and adapter.methods[method].adaptive:
            if self.step is not None:
                raise InputError(f"--step: {adapter.name} {method} chooses its steps; leave it out")
            step = scene.clock.frame
        return Settings(
            method,
            step,
            preset.options if self.method in (None, preset.method) else {},
        )

    def _refusal(self, scene: Scene, left_out: dict[str, str], without: set[str]) -> str:
        """Explain what cannot be done, and suggest methods or engines that can."""
        name, reason = next(iter(left_out.items()))
        by_engine = {
            engine: _able_methods(registry.load_adapter(engine), scene)
            for engine in self.engines
            if engine not in without
        }
        methods = by_engine.get(name)
        able = [engine for engine in self.engines if by_engine.get(engine)]
        hint = f"use --method {' or '.join(methods)}" if methods else "no engine given here can"
        if able and not methods:
            hint = f"use --engines {','.join(able)}"
        return f"{reason}; {hint}"


def is_file(word: str) -> bool:
    """Return whether a word for settings names a file, not a profile."""
    return bool(Path(word).suffix) or os.sep in word


def _profiles(
    words: tuple[str, ...], engines: tuple[str, ...]
) -> tuple[tuple[str, ...], dict[str, dict[str, Matched]]]:
    """Return the names of profiles, and the settings of those in files."""
    profiles, by_profile = list[str](), dict[str, dict[str, Matched]]()
    for word in words:
        if not is_file(word):
            profiles.append(as_profile(word))
            continue
        name, settings = read_settings(Path(word))
        missing = [engine for engine in engines if engine not in settings]
        if missing and (name == MATCHED or len(missing) == len(engines)):
            available = ", ".join(settings)
            msg = f"--settings {word}: no settings of {missing[0]}; there are: {available}"
            raise InputError(msg)
        profiles.append(name)
        by_profile[name] = settings
    if not profiles or len(set(profiles)) < len(profiles):
        raise InputError(
            f"--settings: got {','.join(words) or 'none'}, allowed is each name once; a file "
            "without a `name` is called matched"
        )
    return tuple(profiles), by_profile


def _able_methods(adapter: Adapter, scene: Scene) -> list[str]:
    if adapter.cannot_hold(scene):
        return []
    return [name for name in adapter.methods if not adapter.refusals(scene, name)]


def words_of(names: str | Path | Iterable[str | Path], option: str) -> tuple[str, ...]:
    """Split a text at commas; each word counts once, and a path is one word.

    Raises:
        InputError: The words are neither a text or path nor several; the message names the option.
    """
    words = names.split(",") if isinstance(names, str) else names
    words = (words,) if isinstance(words, Path) else words
    words = tuple(words) if isinstance(words, Iterable) else (None,)
    if not all(isinstance(word, str | Path) for word in words):
        msg = f"got {names!r}, allowed are names, as 'one,other' or ['one', 'other']"
        raise InputError(f"{option}: {msg}")
    return tuple(dict.fromkeys(str(word).strip() for word in words))


class Matched(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of one engine as written in a file, independent of the frame interval.

    The figures obtained with them, `found` in each table of the file, are for people.
    """

    method: str
    steps_per_frame: int
    options: dict[str, float | int | bool | str] = {}

    def settings(self, scene: Scene) -> Settings:
        """Return the settings for a scene."""
        return Settings(self.method, scene.clock.frame / self.steps_per_frame, self.options)


def settings_for(scene: Scene, adapter: Adapter, profile: Profile) -> Settings:
    """Return the settings without a search.

    `matched` settings that have been found and checked for a built-in scene are stored in
    `scenes/matched/`, one file per scene; those of an engine that another package adds are in the
    folder that this package registers. They apply to scenes of the same name and physics.
    For other scenes the adapter makes a careful choice; `mbds_xsim.measure.quick` searches first.

    Raises:
        Unsupported: The adapter gives no settings, or those that its package ships are wrong.
    """
    if profile == MATCHED and is_stored(scene, adapter.name):
        own = _stored(scene.name).get(adapter.name)
        return own.settings(scene) if own else _shipped_settings(scene, adapter)
    return adapter.settings(scene, profile)


def is_stored(scene: Scene, engine: str) -> bool:
    """Return whether settings are stored for an engine and a scene of this name and physics."""
    found = engine in _stored(scene.name) or _shipped(scene.name, engine) is not None
    return found and _physics(scene) == _built_in(scene.name)


def read_settings(path: Path) -> tuple[str, dict[str, Matched]]:
    """Read a settings file: its name, and the settings of each engine.

    `mbds-xsim match --out` writes such a file; its settings are called matched. With another `name`
    they are a variant, which need not meet the budgets.

    Raises:
        InputError: The file cannot be read or is no settings file, or the engine of a table is
            unknown or not installed; the message says where.
    """
    try:
        name, settings = _read(path)
        for engine, entry in settings.items():
            adapter = registry.load_adapter(engine)
            adapter.check_options(entry.method, entry.options)
            if adapter.methods[entry.method].adaptive and entry.steps_per_frame != 1:
                raise InputError(
                    f"{engine}.steps_per_frame: got {entry.steps_per_frame}, "
                    f"allowed is 1, since {entry.method} chooses its steps"
                )
    except InputError as error:
        raise InputError(f"--settings {path}: {error}") from error
    return name, settings


def _read(path: Path) -> tuple[str, dict[str, Matched]]:
    """Read a settings file, whose engines need not be installed; messages do not name it."""
    try:
        name, settings = _tables(read_file(path).decode("utf-8-sig"))
    except msgspec.ValidationError as error:
        raise InputError(
            f"{error}; each engine needs a table with `method`, "
            "`steps_per_frame` and, if any, `options`, as written by `mbds-xsim match --out`"
        ) from error
    except FileNotFoundError as error:
        raise InputError(
            f"there is no such file; allowed are {MATCHED}, {_NATIVE} and files as "
            "`mbds-xsim match --out` writes them"
        ) from error
    except (OSError, ValueError) as error:  # no UTF-8, no TOML or an endless number
        raise InputError(f"cannot be read: {error}") from error
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name == _NATIVE:
        raise InputError(
            f"name: got {name!r}, allowed are up to 40 small letters, digits "
            f"and _, a letter first, and not {_NATIVE}"
        )
    for engine, entry in settings.items():
        if not 1 <= entry.steps_per_frame < MOST_STEPS:
            raise InputError(
                f"{engine}.steps_per_frame: got {entry.steps_per_frame!r:.60}, allowed is "
                f"1 or more, below {MOST_STEPS:.0e}"
            )
    if not settings:
        raise InputError("got no settings for any engine")
    return name, settings


@functools.cache
def _stored(scene_name: str) -> Mapping[str, Matched]:
    """Read the toolkit's stored settings of a scene."""
    entry = files("mbds_xsim_scenes") / "matched" / f"{scene_name}.toml"
    return _tables(entry.read_text("utf-8"))[1] if entry.is_file() else {}


@functools.cache
def _shipped(scene_name: str, engine: str) -> Matched | str | None:
    """Read the settings of a scene that the engine's package ships; a text says what is wrong."""
    point = registry.registered("mbds_xsim.matched").get(engine)
    if point is None:
        return None
    top, *below = point.value.split(".")
    try:
        package = find_spec(top)  # which imports nothing
        if package is None:
            return f"there is no package {top}, which its entry point names"
        for folder in package.submodule_search_locations or ():
            path = Path(folder, *below, f"{scene_name}.toml")
            if path.is_file():
                return _read(path)[1].get(engine)
    except InputError as error:
        return f"{path}: {error}"
    except (OSError, ValueError) as error:
        return str(error)
    return None


def _shipped_settings(scene: Scene, adapter: Adapter) -> Settings:
    """Return the settings that the engine's package ships, if they are right."""
    entry = _shipped(scene.name, adapter.name)
    try:
        if not isinstance(entry, Matched):
            raise InputError(entry)
        settings = entry.settings(scene)
        with suppress(Unsupported):  # another of its methods may support the scene
            adapter.check(scene, settings)
    except InputError as error:
        msg = f"{adapter.name} {MATCHED}: the settings that its package ships: {error}"
        raise Unsupported(msg) from error
    return settings


def _tables(text: str) -> tuple[Any, dict[str, Matched]]:
    tables: Any = tomllib.loads(text)
    name = tables.pop("name", MATCHED)
    settings = {}
    for engine, table in tables.items():
        if isinstance(table, dict):
            table.pop("found", None)
        try:
            settings[engine] = msgspec.convert(table, Matched)
        except msgspec.ValidationError as error:
            raise msgspec.ValidationError(f"{engine}: {error}") from error
    return name, settings


@functools.cache
def _built_in(scene_name: str) -> str:
    """Return the physics of the built-in scene of a name; "" if there is none."""
    try:
        return _physics(registry.load_scene(scene_name))
    except InputError:
        return ""


def _physics(scene: Scene) -> str:
    """Return a fingerprint of all that decides a scene's settings, which its duration does not."""
    return fingerprint(
        msgspec.structs.replace(scene, clock=msgspec.structs.replace(scene.clock, steps=1))
    )


def as_profile(name: str) -> Profile:
    """Check a profile's name and return it."""
    profiles: dict[str, Profile] = {"matched": "matched", "native": "native"}
    check_name("settings profile", name, sorted(profiles))
    return profiles[name]
