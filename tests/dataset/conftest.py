"""Data sets small enough to make many of: a swinging rod, ten frames, the smallest of shards."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.isolate import Silent
from mbds_xsim.dataset.audit import Audited, audit_file
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.dataset.generate import Generated, Request, generate
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene

from .foreign_files import NAMED, Arrays, Audit, simulated

TEXTS = ("1pendulum/README.md", "1pendulum/croissant.json")
SHARD = "1pendulum/mujoco-matched/0000000000.h5"
FILE = "1pendulum/mujoco-matched.h5"
JOINT = "1pendulum/joint.h5"
TRAJECTORIES = 40  # three shards, of 16, 16 and 8
STEPS = 10

Make = Callable[..., Generated]


class Silence(Silent):
    """Progress sink that counts and keeps notices."""

    def __init__(self) -> None:
        self.total = self.done = self.rejected = 0
        self.notices: list[str] = []

    def begin(self, total: int, done: int = 0) -> None:
        self.total, self.done = total, done

    def made(self, done: int, rejected: int) -> None:
        self.done += done
        self.rejected += rejected

    def notice(self, line: str) -> None:
        self.notices.append(line)


@pytest.fixture(scope="session")
def rod() -> Scene:
    """One pendulum that is recorded for a fifth of a second."""
    return msgspec.structs.replace(load_scene("1pendulum"), clock=Clock(steps=STEPS))


@pytest.fixture(scope="session")
def make(rod: Scene) -> Make:
    """Make a set of the rod in a folder, in this process unless told otherwise."""

    def run(
        out: Path,
        *,
        scene: Scene = rod,
        trajectories: int = TRAJECTORIES,
        engines: str = "mujoco",
        settings: str = "matched",
        seed: int = 0,
        noise: bool = True,
        workers: int = 0,
        progress: Silence | None = None,
    ) -> Generated:
        choice = Choice.parse(engines=engines, profiles=settings)
        request = Request((scene,), choice, trajectories, out, seed=seed, noise=noise)
        return generate(request, workers=workers, progress=progress or Silence())

    return run


@pytest.fixture(scope="session")
def whole(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished set, not to be changed."""
    out = tmp_path_factory.mktemp("whole")
    make(out)
    return out


@pytest.fixture(scope="session")
def few(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight trajectories, not to be changed."""
    out = tmp_path_factory.mktemp("few")
    make(out, trajectories=8)
    return out


def contents(folder: Path) -> dict[str, str]:
    """Return checksums of all data files, cards and metadata, keyed by path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".h5", ".md", ".json")
    }


@pytest.fixture
def copy(few: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(few, tmp_path / "copy"))


@pytest.fixture(scope="session")
def swing(rod: Scene) -> Arrays:
    """Two trajectories of the rod, not to be changed."""
    return simulated(rod)


@pytest.fixture(scope="session")
def drop() -> tuple[Scene, Arrays]:
    """A disc of 19 particles in a plane, which determine its rotation."""
    scene = load_scene("balldrop")
    return scene, simulated(scene)


@pytest.fixture
def audited(tmp_path: Path) -> Audit:
    def run(scene: Scene, arrays: Arrays, provenance: Provenance = NAMED) -> Audited:
        np.savez(tmp_path / "it.npz", **arrays)  # type: ignore[arg-type]
        return audit_file(tmp_path / "it.npz", scene, provenance)

    return run
