"""Packages with adapters of their own, installed for a test."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import MappingProxyType

import pytest

from mbds_xsim.simulate import choice, registry

__all__ = ["faulty", "installed"]

# Engines that stand on the ground MuJoCo gives and go wrong in one way each.
_FAULTY = """
import dataclasses, os, sys, time
import numpy as np
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.state import Failure, Trajectory
from mbds_xsim.simulate.adapter import ModelSize, Settings
from mbds_xsim.simulate.claims import Method, Option
from mbds_xsim_adapters.mujoco import MuJoCo

class Aborting(MuJoCo):
    name = "aborting"
    def load(self, scene, settings):
        os.abort()

class Raising(MuJoCo):
    name = "raising"
    def load(self, scene, settings):
        raise RuntimeError("the model has\\ntoo many bodies")

class Leaving(MuJoCo):
    name = "leaving"
    def load(self, scene, settings):
        print("licence expired")
        sys.exit(3)

class Hanging(MuJoCo):
    name = "hanging"
    def load(self, scene, settings):
        time.sleep(600)

class Moving(MuJoCo):
    def load(self, scene, settings):
        run = super().load(scene, settings)
        run.rollout = lambda batch: self.motion(scene, batch)
        return run

class Misshapen(Moving):
    name = "misshapen"
    def motion(self, scene, batch):
        return Trajectory.empty(np.arange(3.0), 1, 7)

class Ageless(MuJoCo):
    name = "ageless"
    def version(self):
        raise OSError("no version file")

class Leaking(MuJoCo):
    name = "leaking"
    def load(self, scene, settings):
        kept = []
        while True:
            kept.append(bytearray(10**7))

class Unread(MuJoCo):
    name = "unread"
    def load(self, scene, settings):
        run = super().load(scene, settings)
        run.readback = lambda batch: dataclasses.replace(type(run).readback(run, batch), mass=None)
        return run

class Pondering(MuJoCo):
    name = "pondering"
    def settings(self, scene, profile):
        time.sleep(600)

class Refusing(MuJoCo):
    name = "refusing"
    def settings(self, scene, profile):
        raise Unsupported("it needs three bodies")

class Choosy(MuJoCo):
    name = "choosy"
    def settings(self, scene, profile):
        if len(scene.bodies) > 5:
            raise Unsupported("it takes five bodies at most")
        return super().settings(scene, profile)

class Adapting(MuJoCo):
    name = "adapting"
    methods = {"adaptive": Method("adaptive", "RK4", 4, adaptive=True), **MuJoCo.methods}
    options = {**MuJoCo.options, "rtol": Option(1e-6, "tolerance", above=0.0)}
    def settings(self, scene, profile):
        fixed = profile == "native"
        method, count = ("RK4", 2) if fixed else ("adaptive", 1)
        return Settings(method, scene.clock.frame / count)
    def load(self, scene, settings):
        if settings.method == "adaptive":
            assert settings.step == scene.clock.frame
            settings = Settings("Euler", settings.step)
        return super().load(scene, settings)

class Blowing(Moving):
    name = "blowing"
    def motion(self, scene, batch):
        time = scene.clock.frame * np.arange(batch.steps + 1)
        whole = Trajectory.empty(time, len(batch), len(scene.bodies))
        fields = (whole.position, whole.orientation, whole.velocity, whole.angular_velocity)
        return Trajectory(time, *fields, (Failure(1, "a number is not finite"),))

class Losing(Moving):
    name = "losing"
    def load(self, scene, settings):
        run = super().load(scene, settings)
        run.size = ModelSize(np.int64(3), np.int64(0))
        return run
    def motion(self, scene, batch):
        time = scene.clock.frame * np.arange(batch.steps + 1)
        return Trajectory.empty(time, len(batch), len(scene.bodies))
"""
_MODULES = {
    "faulty_engines": _FAULTY,
    "broken_import": "raise RuntimeError('its licence\\nhas expired')",
    "dead_import": "import os; os.abort()",
    "endless_import": "import time; time.sleep(600)",
}
_PLACES = {
    "brokenly": "broken_import:X",
    "deadly": "dead_import:X",
    "endlessly": "endless_import:X",
}


def faulty(folder: Path, *names: str) -> AbstractContextManager[None]:
    """Install engines that go wrong, each in the way that its name says."""
    places = {name: _PLACES.get(name, f"faulty_engines:{name.capitalize()}") for name in names}
    return installed(folder, _MODULES, places)


@contextmanager
def installed(
    folder: Path,
    modules: Mapping[str, str],
    engines: Mapping[str, str] = MappingProxyType({}),
    *,
    matched: Mapping[str, str] = MappingProxyType({}),
    models: Mapping[str, str] = MappingProxyType({}),
    writers: Mapping[str, str] = MappingProxyType({}),
) -> Iterator[None]:
    """Install a package for this process and those it starts.

    Args:
        folder: Folder that it is put into.
        modules: Source of each of its modules.
        engines: Place of the adapter of each engine, "module:Class".
        matched: Folder of the matched settings of each engine.
        models: Place of the class of each learned model.
        writers: Place of the writer of each format.
    """
    name = folder.name.replace("-", "_")
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir(parents=True)
    for module, source in modules.items():
        (folder / f"{module}.py").write_text(source)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    groups = {"adapters": engines, "matched": matched, "models": models}
    groups["model_writers"] = writers
    lines = [
        f"[mbds_xsim.{group}]\n" + "".join(f"{key} = {place}\n" for key, place in points.items())
        for group, points in groups.items()
    ]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        _forget()
        try:
            yield
        finally:
            _forget()


def _forget() -> None:
    registry.registered.cache_clear()
    registry._answer.cache_clear()
    choice._shipped.cache_clear()
