"""Who takes part in a study: methods of engines, and what else steps a scene."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from mbds_xsim.base.errors import InputError, UnknownName, Unsupported
from mbds_xsim.base.isolate import Task
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.measure.identity import row_key
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, Profile, Settings
from mbds_xsim.simulate.catalogue import as_profile
from mbds_xsim.simulate.choice import is_file
from mbds_xsim.simulate.matched import settings_for
from mbds_xsim.studies.stability.definition import COUNTS, Case, Study, Value
from mbds_xsim.studies.stability.rows import Options
from mbds_xsim.studies.stability.verdict import run_cells


class Contender(Protocol):
    """What steps the scenes of a study."""

    @property
    def engine(self) -> str:
        """Name of the engine or model."""

    @property
    def method(self) -> str:
        """By which it steps, or how it was trained."""

    @property
    def profile(self) -> Profile:
        """Of the settings, or of the data it was trained on."""

    @property
    def version(self) -> str:
        """Of the engine, or of what runs the model."""

    @property
    def family(self) -> str:
        """Of methods."""

    @property
    def name(self) -> str:
        """Engine, method and profile."""

    @property
    def source(self) -> str:
        """File that it comes from; empty for engines."""

    @property
    def versions(self) -> dict[str, str]:
        """Of the packages behind it, by name."""

    def clock(self, study: Study) -> Clock:
        """Give the frames that it is recorded at."""

    def counts(self, asked: Sequence[int]) -> tuple[int, ...]:
        """Give the steps a frame that it takes, of those that are asked for."""

    def refusal(self, study: Study, scene: Scene) -> str:
        """Say why it cannot do a scene; "" where it can."""

    def options(self, scene: Scene) -> Options:
        """Give the options that it steps a scene with."""

    def key(self, case: Case, count: int) -> str:
        """Hash all of it that decides the figures at a number of steps a frame."""

    def group(self, value: Value) -> tuple[Value, ...]:
        """Tell which cells share a process: those of equal groups."""

    def task(self, cells: Sequence[tuple[Case, int]], limit: float) -> Task:
        """Run cells of a group one after the other, a `Judged` each, within a time [s]."""


@dataclass(frozen=True)
class EngineMethod:
    """A method of an engine, with the options of a profile; see `Contender`."""

    engine: str
    method: str
    profile: Profile
    source: str = ""

    @property
    def name(self) -> str:
        """Engine, method and profile."""
        return f"{self.engine} {self.method}" + (" native" if self.profile == "native" else "")

    @property
    def version(self) -> str:
        """Of the engine."""
        return registry.load_adapter(self.engine).version()

    @property
    def versions(self) -> dict[str, str]:
        """Of the engine, by its name."""
        return {self.engine: self.version}

    @property
    def family(self) -> str:
        """Of the method."""
        return registry.load_adapter(self.engine).methods[self.method].family

    def settings(self, scene: Scene, count: int) -> Settings:
        """Give the settings at a number of steps a frame.

        Options are those of the engine's settings for the scene, whatever the method.
        """
        preset = settings_for(scene, registry.load_adapter(self.engine), self.profile)
        return Settings(self.method, scene.clock.frame / count, dict(preset.options))

    def clock(self, study: Study) -> Clock:
        """Give the study's own."""
        return study.clock

    def counts(self, asked: Sequence[int]) -> tuple[int, ...]:
        """Give all."""
        return tuple(asked)

    def refusal(self, study: Study, scene: Scene) -> str:
        """Ask the adapter."""
        del study
        try:
            registry.load_adapter(self.engine).check(scene, self.settings(scene, 1))
        except Unsupported as error:
            return str(error)
        return ""

    def options(self, scene: Scene) -> Options:
        """Give those of the settings."""
        return dict(self.settings(scene, 1).options)

    def key(self, case: Case, count: int) -> str:
        """Hash motion, settings, code and machine."""
        return row_key(case.scene, case.batch, self.engine, self.settings(case.scene, count))

    def group(self, value: Value) -> tuple[Value, ...]:
        """Put the steps at a value together."""
        return self.name, value

    def task(self, cells: Sequence[tuple[Case, int]], limit: float) -> Task:
        """Run the steps of a scene; half the time is left to the last that is begun."""
        case = cells[0][0]
        settings = [self.settings(case.scene, count) for _, count in cells]
        arguments = (case.scene, case.batch, self.engine, settings, case.truth, limit / 2.0)
        return Task(run_cells, arguments, limit)


def contenders_of(
    study: Study,
    scenes: Sequence[Scene],
    engines: Sequence[str],
    methods: Sequence[str],
    profiles: Sequence[Profile],
    others: Sequence[Contender] = (),
) -> tuple[list[Contender], dict[str, str]]:
    """List who takes part, and who can do none of the scenes, with the reason.

    `matched` takes every method, `native` the one that a user of the engine gets.

    Raises:
        InputError: Nobody takes part, or a method that is named belongs to none of the engines.
    """
    asked: list[Contender] = []
    found: list[Contender] = []
    left_out: dict[str, str] = {}
    for name, profile in itertools.product(engines, profiles):
        try:
            able = _methods(registry.load_adapter(name), scenes[0], profile, methods)
        except Unsupported as error:
            left_out[name] = str(error)
        else:
            asked += [EngineMethod(name, method, profile) for method in able]
    for contender in [*asked, *others]:
        reasons = [contender.refusal(study, scene) for scene in scenes]
        if all(reasons):
            left_out[contender.name] = reasons[0]
        else:
            found.append(contender)
    _check_named(methods, {method for name in engines for method in _all_methods(name)})
    if not found:
        reason = next(iter(left_out.values()), "no method that is named belongs to these settings")
        msg = f"nothing to run in {study.name}: {reason}"
        raise InputError(msg)
    return found, left_out


def profiles_of(words: str) -> tuple[Profile, ...]:
    """Read the profiles from a user's words, each once."""
    if paths := [word for word in words.split(",") if is_file(word)]:
        msg = (
            f"--settings {paths[0]}: a file has the settings of one scene, and a map makes scenes "
            "and steps of its own; allowed are matched, native, or both"
        )
        raise InputError(msg)
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


LIMIT = 30.0
"""Longest that a cell may take [s]."""


@dataclass(frozen=True)
class Plan:
    """What of a study is carried out, and how."""

    study: Study
    engines: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    """All of an engine's where none is named."""
    profiles: tuple[Profile, ...] = ("matched", "native")
    values: tuple[Value, ...] = ()
    """The study's where none is given."""
    counts: tuple[int, ...] = COUNTS
    """Steps a frame, the fewest first."""
    limit: float = LIMIT
    """Longest that a cell may take [s]."""
    workers: int | None = None
    """Processes at a time; all cores when None, none but this one for 0."""
    fresh: bool = False
    """Whether cells that were measured earlier are measured again."""
    cache: bool = True
    """Whether reference solutions are kept."""
    command: str = ""
    others: tuple[Contender, ...] = ()
    """Who takes part beside the engines' methods."""
    faulty: Mapping[str, str] = field(default_factory=dict)
    """Engines that would take part but cannot be used, each with the reason."""


@dataclass(frozen=True, eq=False)
class Job:
    """One cell to be run."""

    case: Case
    contender: Contender
    count: int
    """Steps a frame."""
    key: str
    """Hash of all that decides the figures."""

    @staticmethod
    def of(case: Case, contender: Contender, count: int) -> Job:
        """Make a job, with its key."""
        what = (CHECKS, contender.key(case, count), case.truth is None, case.batch.steps)
        key = hashlib.sha256(repr(what).encode()).hexdigest()
        return Job(case, contender, count, key)
