"""Which methods of which engines a study compares, and with what options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mbds_xsim import registry
from mbds_xsim.catalogue import as_profile
from mbds_xsim.engine import Adapter, Profile, Settings
from mbds_xsim.errors import InputError, UnknownName, Unsupported
from mbds_xsim.matched import settings_for
from mbds_xsim.scene import Scene

__all__ = ["Contender", "contenders_of", "profiles_of"]


@dataclass(frozen=True)
class Contender:
    """A method of an engine, with the options of a profile."""

    engine: str
    method: str
    profile: Profile

    @property
    def name(self) -> str:
        """Engine, method and profile."""
        return f"{self.engine} {self.method}" + (" native" if self.profile == "native" else "")

    def settings(self, scene: Scene, count: int) -> Settings:
        """Give the settings at a number of steps a frame.

        Options are those of the engine's settings for the scene, whatever the method.
        """
        preset = settings_for(scene, registry.load_adapter(self.engine), self.profile)
        return Settings(self.method, scene.clock.frame / count, dict(preset.options))


def contenders_of(
    study: str,
    scenes: Sequence[Scene],
    engines: Sequence[str],
    methods: Sequence[str],
    profiles: Sequence[Profile],
) -> tuple[list[Contender], dict[str, str]]:
    """List who takes part, and the methods that can do none of the scenes, with the reason.

    `matched` takes every method, `native` the one that a user of the engine gets.

    Raises:
        InputError: Nobody takes part, or a method that is named belongs to none of the engines.
    """
    found: list[Contender] = []
    left_out: dict[str, str] = {}
    for name in engines:
        adapter = registry.load_adapter(name)
        for profile in profiles:
            for method in _methods(adapter, scenes[0], profile, methods):
                contender = Contender(name, method, profile)
                reasons = [_refusal(adapter, scene, contender) for scene in scenes]
                if all(reasons):
                    left_out[contender.name] = reasons[0]
                else:
                    found.append(contender)
    _check_named(methods, {method for name in engines for method in _all_methods(name)})
    if not found:
        reason = next(iter(left_out.values()), "no method that is named belongs to these settings")
        msg = f"nothing to run in {study}: {reason}"
        raise InputError(msg)
    return found, left_out


def profiles_of(words: str) -> tuple[Profile, ...]:
    """Read the profiles from a user's words, each once."""
    return tuple(dict.fromkeys(as_profile(word.strip()) for word in words.split(",")))


def _methods(adapter: Adapter, scene: Scene, profile: Profile, named: Sequence[str]) -> list[str]:
    usual = adapter.settings(scene, "native").method
    able = [usual] if profile == "native" else list(adapter.methods)
    return [method for method in able if not named or method in named]


def _all_methods(engine: str) -> list[str]:
    return list(registry.load_adapter(engine).methods)


def _check_named(methods: Sequence[str], known: set[str]) -> None:
    for method in methods:
        if method not in known:
            raise UnknownName.of("method of these engines", method, sorted(known))


def _refusal(adapter: Adapter, scene: Scene, contender: Contender) -> str:
    try:
        adapter.check(scene, contender.settings(scene, 1))
    except Unsupported as error:
        return str(error)
    return ""
