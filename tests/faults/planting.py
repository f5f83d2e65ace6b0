"""Faults, and how they are planted in one engine while all others stay sound."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest import mock

from mbds_xsim.base.files import write_whole
from mbds_xsim.measure.campaign import reference_of
from mbds_xsim.measure.judge import Judged, judge, reference_result
from mbds_xsim.measure.outcome import Outcome, ReferenceOutcome
from mbds_xsim.measure.result import ReferenceResult
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Adapter, Profile, Readback, Run, Settings
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import Simulation, checked, simulate

__all__ = ["Change", "Fault", "Faulty", "planted", "share"]


def _same_model(scene: Scene) -> Scene:
    return scene


def _same_settings(settings: Settings) -> Settings:
    return settings


def _same_inputs(batch: Batch) -> Batch:
    return batch


def _same_motion(_scene: Scene, _batch: Batch, _step: float, motion: Trajectory) -> Trajectory:
    return motion


@dataclass(frozen=True, eq=False)
class Change:
    """A change of the inputs that reach an engine, of its adapter, or of its recorded motion."""

    model: Callable[[Scene], Scene] = _same_model
    settings: Callable[[Settings], Settings] = _same_settings
    inputs: Callable[[Batch], Batch] = _same_inputs
    motion: Callable[[Scene, Batch, float, Trajectory], Trajectory] = _same_motion
    """Recording, given the true scene, the true batch, the step [s] and the true recording."""
    native: Callable[[str], AbstractContextManager[object]] = contextlib.nullcontext
    """Context that changes the adapter of the named engine while it runs."""
    told: str = ""
    """Start of the read-back's line that reports it; empty if no engine can."""

    @property
    def only_recorded(self) -> bool:
        """Whether the engine itself runs as it would without the change."""
        changes = (self.model, self.settings, self.inputs, self.native)
        return changes == (_same_model, _same_settings, _same_inputs, contextlib.nullcontext)


@dataclass(frozen=True, eq=False)
class Fault:
    """A user's mistake."""

    name: str
    scene: str
    """Name of a scene in which the fault can show."""
    engines: tuple[str, ...]
    """Engines into which it is planted, one at a time."""
    checks: tuple[str, ...]
    """Checks meant for the fault, of which one must fail."""
    change: Change
    untold: tuple[str, ...] = ()
    """Engines whose read-back cannot report it."""
    odd: bool = False
    """Whether it is large enough for the engines' vote to name the faulty one."""
    unseen: Mapping[str, str] = field(default_factory=dict)
    """Engines in whose motion no check sees it, with the reason."""


@contextlib.contextmanager
def planted(change: Change | None, engine: str) -> Iterator[None]:
    """Plant a change into the simulations that a validation in this process makes.

    Everything that does not depend on it is simulated, solved and judged only once.
    """

    def run(scene: Scene, batch: Batch, name: str, settings: Settings) -> Simulation:
        return _simulated(change if name == engine else None, scene, batch, name, settings)

    with (
        mock.patch("mbds_xsim.measure.campaign.simulate", run),
        mock.patch("mbds_xsim.measure.refinement.simulate", run),
        mock.patch("mbds_xsim.measure.campaign.reference_of", _solved),
        mock.patch("mbds_xsim.studies.validate.judge", _judged),
        mock.patch("mbds_xsim.studies.validate.reference_result", _audited),
    ):
        yield


_Key = tuple[object, ...]
_DONE: dict[_Key, Simulation] = {}
_ROWS: dict[_Key, Judged] = {}
_SOLVED: dict[_Key, ReferenceOutcome] = {}
_AUDITED: dict[_Key, ReferenceResult] = {}


def share(folder: Path) -> None:
    """Let all workers of a test run share the simulations of sound engines."""
    global _SHARED
    _SHARED = folder


_SHARED: Path | None = None


def _drawn(scene: Scene, batch: Batch) -> _Key:
    """Return a key of the trajectories; starts follow from the scene and their indices."""
    return scene, batch.index.tobytes(), batch.force.tobytes()


def _simulated(
    change: Change | None, scene: Scene, batch: Batch, engine: str, settings: Settings
) -> Simulation:
    key = (change, engine, repr(settings), *_drawn(scene, batch))
    if key not in _DONE:
        path = _SHARED and _SHARED / hashlib.sha256(repr(key).encode()).hexdigest()
        if change is None and path and path.exists():
            _DONE[key] = pickle.loads(path.read_bytes())
        else:
            _DONE[key] = _carried_out(change, scene, batch, engine, settings)
            if change is None and path:
                write_whole(path, pickle.dumps(_DONE[key]))
    return _DONE[key]


def _solved(scene: Scene, batch: Batch, cache: bool) -> ReferenceOutcome:
    key = _drawn(scene, batch)
    if key not in _SOLVED:
        _SOLVED[key] = reference_of(scene, batch, cache)
    return _SOLVED[key]


def _audited(scene: Scene, batch: Batch, reference: ReferenceOutcome) -> ReferenceResult:
    key = _drawn(scene, batch)
    if key not in _AUDITED:
        _AUDITED[key] = reference_result(scene, batch, reference)
    return _AUDITED[key]


def _judged(outcome: Outcome, reference: ReferenceOutcome, *, native: bool) -> Judged:
    """Judge every outcome once; simulations are never repeated, so their ids identify it."""
    key = (outcome.scene, outcome.contender.engine, native, *map(id, outcome.parts))
    if key not in _ROWS:
        _ROWS[key] = judge(outcome, reference, native=native)
    return _ROWS[key]


def _carried_out(
    change: Change | None, scene: Scene, batch: Batch, engine: str, settings: Settings
) -> Simulation:
    if change is None:
        return simulate(scene, batch, engine, settings)
    if change.only_recorded:
        sound = _simulated(None, scene, batch, engine, settings)
        motion = change.motion(scene, batch, settings.step, sound.trajectory)
        run = cast(Run, SimpleNamespace(rollout=lambda _: motion))
        recorded = checked(run.rollout(batch), batch, scene.clock.frame)
        return dataclasses.replace(sound, trajectory=recorded)
    adapter = Faulty(load_adapter(engine), change)
    loading = mock.patch("mbds_xsim.simulate.timed.load_adapter", return_value=adapter)
    with change.native(engine), loading:
        return simulate(scene, batch, engine, settings)


class Faulty(Adapter):
    """An adapter with a fault."""

    def __init__(self, adapter: Adapter, change: Change) -> None:
        self._adapter, self._change = adapter, change
        for claim in ("name", "package", "methods", "options", "limits", "coordinates"):
            setattr(self, claim, getattr(adapter, claim))

    def version(self) -> str:
        return self._adapter.version()

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        return self._adapter.settings(scene, profile)

    def load(self, scene: Scene, settings: Settings) -> Run:
        run = self._adapter.load(self._change.model(scene), self._change.settings(settings))
        return _FaultyRun(run, self._change, scene, settings.step)


class _FaultyRun(Run):
    def __init__(self, run: Run, change: Change, scene: Scene, step: float) -> None:
        self._run, self._change, self._scene, self._step = run, change, scene, step
        self.size = run.size

    def rollout(self, batch: Batch) -> Trajectory:
        motion = self._run.rollout(self._change.inputs(batch))
        return self._change.motion(self._scene, batch, self._step, motion)

    def readback(self, batch: Batch) -> Readback:
        return self._run.readback(self._change.inputs(batch))

    def native(self, batch: Batch) -> str:
        return self._run.native(batch)

    def close(self) -> None:
        self._run.close()
