"""Measurement of an engine's releases, all at the same settings.

A release is a folder of packages (`environments`). Its cases run in processes that use these in
place of this environment's packages: the ladder of small cases with exact answers, the paper's
scenes, and a ball's rebound. References are computed in this environment.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError, check_name
from mbds_xsim.base.isolate import USUAL, Conduct, Crash, Task, run_tasks
from mbds_xsim.base.text import on_a_line
from mbds_xsim.measure.runner import Runner, Store, StudyCase, machine, row_key, versions_of
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Adapter, Profile
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import PAPER_SCENES, engine_names, load_adapter, load_scene
from mbds_xsim.simulate.simulator import EngineMethod, Simulator
from mbds_xsim.studies.contact import ContactBench, reason
from mbds_xsim.studies.contact.impacts import rebounds
from mbds_xsim.studies.releases.environments import add, install, releases_of
from mbds_xsim.studies.releases.steps import (
    SCHEMA,
    History,
    Release,
    ReleaseRow,
    known_of,
    steps_of,
)
from mbds_xsim.studies.tradeoff.bench import Truth, measure, references
from mbds_xsim.testing.cases import CASES
from mbds_xsim.testing.contact_cases import RESTITUTION
from mbds_xsim.testing.ladder import EXACT, STEPS_PER_FRAME, case_settings, measured_order

PROFILES: tuple[Profile, ...] = ("native", "matched")

_VERSION = 1
"""Version of the measurement; raise it when figures of a case change their meaning."""
_START = 1  # index of a start in the medium interval
_SPEEDS = (0.5, 2.0)  # at which a ball hits the ground [m/s]
_BOUNCING = "balldrop"
_OLD_NUMPY = "numpy.core.multiarray failed to import"
"""Message by which an engine compiled for numpy 1 is recognised."""
_LAST = 10
"""Number of releases if no number is given, and no first release is given or known."""
_LIMIT = 120.0
"""Time limit of a case, or of the cases of one process together [s]."""
_MIDDLE = STEPS_PER_FRAME.index(8)


@dataclass
class ReleaseStudy:
    """An engine, and the scenes on which its releases are measured."""

    engine: str
    conduct: Conduct = USUAL
    scenes: Sequence[str] = PAPER_SCENES
    _truths: dict[str, tuple[Batch, Truth]] = field(default_factory=dict)

    def history(self, since: str = "", last: int | None = None, *, command: str = "") -> History:
        """Measure the releases since one of them, or the last ones.

        Args:
            since: First release; if empty, the one listed in `changes.toml`, if any.
            last: Largest number of releases, the newest ones.
            command: Command to record in the result.

        Raises:
            InputError: There is no such engine or release, or the index cannot be read.
        """
        begin = time.perf_counter()
        check_name("engine", self.engine, engine_names())
        known = known_of(self.engine)
        since = since or known.since
        versions = releases_of(self.adapter.package, since, last or (None if since else _LAST))
        parts = {version: self._release(version) for version in versions}
        rows = tuple(row for part in parts.values() if not isinstance(part, str) for row in part)
        return History(
            schema=SCHEMA,
            engine=self.engine,
            package=self.adapter.package,
            command=command,
            machine=machine(),
            versions=versions_of({}),
            measured=self._runner.measured,
            kept=self._runner.reused,
            wall_s=time.perf_counter() - begin,
            change_log=known.source,
            releases=tuple(
                Release(version, part if isinstance(part, str) else "")
                for version, part in parts.items()
            ),
            steps=tuple(steps_of(rows, known)),
            rows=rows,
        )

    @cached_property
    def adapter(self) -> Adapter:
        """Adapter of the engine, in this environment."""
        return load_adapter(self.engine)

    @cached_property
    def _runner(self) -> Runner[ReleaseRow]:
        return Runner(
            Store.of("releases", self.engine, ReleaseRow),
            crashed=lambda row, crash: msgspec.structs.replace(
                row, kind=crash.kind, reason=on_a_line(crash.reason)
            ),
            lasts=_lasts,
            conduct=self.conduct,
        )

    def _release(self, version: str) -> list[ReleaseRow] | str:
        """Return the rows of a release, or the reason why there are none."""
        cases = [*self._ladder(version), *self._scene_cases(version), *self._bounces(version)]
        if self._runner.missing(cases):
            folder = install(self.adapter.package, version, fresh=self.conduct.fresh)
            if isinstance(folder, str):
                return folder
            tasks = [Task(drive, (self.engine, version, folder), _LIMIT)]
            (answer,) = run_tasks(tasks, packages=folder)
            if isinstance(answer, Crash) and _OLD_NUMPY in answer.reason:
                add(folder, "numpy<2")
                (answer,) = run_tasks(tasks, packages=folder)
            if isinstance(answer, Crash):
                return on_a_line(answer.reason)
            self._runner.packages = folder
        return self._runner.rows(cases)

    def _ladder(self, version: str) -> Iterator[StudyCase[ReleaseRow]]:
        """Yield the cases of every method on every small case."""
        for case in CASES:
            for name, method in self.adapter.methods.items():
                if not self.adapter.refusals(case.scene, name) and not method.adaptive:
                    settings = case_settings(self.adapter, case, method, STEPS_PER_FRAME[-1])
                    ran = EngineMethod.at(self.engine, case.scene, settings, release=version)
                    start = draw_batch(case.scene, [0])
                    key = row_key(case.scene, start, ran, STEPS_PER_FRAME[-1], _VERSION, "case")
                    row = ReleaseRow(key=key, release=version, case=case.name, way=name)
                    yield _case(row, climb, self.engine, case.name, name)

    def _scene_cases(self, version: str) -> Iterator[StudyCase[ReleaseRow]]:
        """Yield the cases of every scene at native and matched settings."""
        for scene in map(load_scene, self.scenes):
            for ran in self._at_profiles(scene, version):
                (count,), (start, truth) = ran.counts, self._truth(scene)
                key = row_key(scene, start, ran, count, _VERSION, "scene")
                row = ReleaseRow(key=key, release=version, case=scene.name, way=ran.profile)
                yield _case(row, play, ran, scene, start, count, truth)

    def _bounces(self, version: str) -> Iterator[StudyCase[ReleaseRow]]:
        """Yield the cases of a ball's impacts."""
        scene = load_scene(_BOUNCING)
        start = draw_batch(scene, [0])
        for ran in self._at_profiles(scene, version):
            for speed in _SPEEDS:
                key = row_key(scene, start, ran, ran.counts[0], _VERSION, f"rebound {speed}")
                name = f"rebound at {speed:g} m/s"
                row = ReleaseRow(key=key, release=version, case=name, way=ran.profile)
                yield _case(row, bounce, self.engine, ran.profile, speed)

    def _at_profiles(self, scene: Scene, version: str) -> Iterator[EngineMethod]:
        """Yield the engine at the settings of each profile."""
        able = any(not self.adapter.refusals(scene, name) for name in self.adapter.methods)
        for profile in PROFILES if able else ():
            settings = settings_for(scene, self.adapter, profile)
            if not self.adapter.refusals(scene, settings.method):
                yield EngineMethod.at(
                    self.engine, scene, settings, profile=profile, release=version
                )

    def _truth(self, scene: Scene) -> tuple[Batch, Truth]:
        """Return a start of a scene, and its truth."""
        if scene.name not in self._truths:
            start = draw_batch(scene, [_START])
            (truth,) = references(scene, start, self.conduct)
            self._truths[scene.name] = start, truth
        return self._truths[scene.name]


def _lasts(stored: ReleaseRow, _row: ReleaseRow) -> bool:
    """Return whether a stored row can be reused; a crash's cause and a delay's may be external."""
    return stored.kind not in ("crashed", "timed out")


def _case(
    row: ReleaseRow, function: Callable[..., dict[str, Any]], *arguments: Any
) -> StudyCase[ReleaseRow]:
    """Make a case; those of a release with one function and way share a process."""
    return StudyCase(
        row,
        f"{row.release}: {row.name}",
        function,
        lambda: arguments,
        _LIMIT,
        group=(row.release, function, row.way),
        pace=(row.case, row.way),
    )


# Functions that run in a process of a release.


def drive(engine: str, release: str, packages: Path) -> None:
    """Simulate a small case with a release, to check that it can be driven.

    Raises:
        InputError: The engine that runs is not the release of the folder.
    """
    adapter = load_adapter(engine)
    case, settings = next(
        (case, case_settings(adapter, case, method, 1))
        for case in CASES
        for name, method in adapter.methods.items()
        if not adapter.refusals(case.scene, name)
    )
    with adapter.open(case.scene, settings) as run:
        run.rollout(draw_batch(case.scene, [0]))
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    if adapter.version() != release or not any(
        Path(file).is_relative_to(packages) for file in files if file
    ):
        msg = f"what runs is {engine} {adapter.version()}, not the release in {packages}"
        raise InputError(msg)


def climb(engine: str, name: str, method: str) -> dict[str, Any]:
    """Measure error and order of a method on a small case."""
    case = next(case for case in CASES if case.name == name)
    try:
        order, errors = measured_order(load_adapter(engine), case, method)
    except Exception as error:  # old releases may raise anything; it becomes the reason
        return {"kind": "failed", "reason": on_a_line(f"{type(error).__name__}: {error}")}
    return {"error_m": errors[_MIDDLE], "order": order if errors[-1] > EXACT else None}


def play(
    simulator: Simulator, scene: Scene, start: Batch, count: int, truth: Truth
) -> dict[str, Any]:
    """Measure a start of a scene as the trade-off study does."""
    figures = measure(simulator, scene, start, count, truth)
    names = ("kind", "reason", "error_m", "gap_m", "energy")
    return {key: figures[key] for key in names if key in figures} | {"cpu_s": min(figures["cpu_s"])}


def bounce(engine: str, profile: Profile, speed: float) -> dict[str, Any]:
    """Measure the restitution of a ball that hits the ground."""
    ratio, _, motion = rebounds(ContactBench(engine, profile, _BOUNCING), RESTITUTION, speed)
    if failure := reason(motion):
        return {"kind": "failed", "reason": failure}
    return {"restitution": float(np.median(ratio))}
