"""An engine that crashes, hangs or raises is told with the reason; the others' results stay."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mbds_xsim import campaign, registry
from mbds_xsim.isolate import Task

_HANG = 4.0  # [s] until a hanging task is ended

# Engines that stand on the ground MuJoCo gives and go wrong in one way each.
_ENGINES = """
import os, sys, time
import numpy as np
from mbds_xsim.state import Trajectory
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

class Misshapen(MuJoCo):
    name = "misshapen"
    def load(self, scene, settings):
        run = super().load(scene, settings)
        run.rollout = lambda batch: Trajectory.empty(np.arange(3.0), 1, 7)
        return run
"""
_NAMES = ("aborting", "raising", "leaving", "hanging", "misshapen")

_BOB = """
name = "bob"
length = 1.0
clock = { steps = 10 }
[[bodies]]
name = "bob"
particles = [{ position = [0.3, 0.0, -0.4] }]
[[joints]]
name = "pivot"
kind = "ball"
parent = "world"
child = "bob"
anchor = [0, 0, 0]
"""


@pytest.fixture
def faulty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the faulty engines, and lose patience with the one that hangs."""
    packages = tmp_path / "packages"
    metadata = packages / "faulty-1.0.dist-info"
    metadata.mkdir(parents=True)
    (packages / "faulty_engines.py").write_text(_ENGINES)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty\nVersion: 1.0\n")
    points = (f"{name} = faulty_engines:{name.capitalize()}" for name in _NAMES)
    (metadata / "entry_points.txt").write_text("\n".join(["[mbds_xsim.adapters]", *points]))
    monkeypatch.syspath_prepend(packages)
    monkeypatch.setenv("PYTHONPATH", str(packages))
    monkeypatch.setattr(campaign, "Task", _impatient)
    monkeypatch.setattr(campaign, "_REFINEMENT", ())  # one run an engine tells enough
    registry._points.cache_clear()
    yield
    registry._points.cache_clear()


@functools.wraps(Task)
def _impatient(function: Callable[..., Any], arguments: tuple[Any, ...], timeout: float) -> Task:
    return Task(function, arguments, _HANG if "hanging" in arguments else timeout)


@pytest.mark.usefixtures("faulty")
@pytest.mark.slow
def test_each_fault_is_told_and_the_sound_engine_keeps_its_result(
    run: Callable[..., Any], here: Path
) -> None:
    (here / "bob.toml").write_text(_BOB)
    chosen = f"mujoco,{','.join(_NAMES)}"

    ended = run("validate", "bob.toml", "--engines", chosen, "--json", "out.json", "--workers", "8")

    assert ended.code == 1
    assert "Traceback" not in ended.out + ended.err
    told = json.loads((here / "out.json").read_text())
    rows = {row["engine"]: row for row in told["engines"]}
    assert told["verdict"] == "fail"
    assert rows["mujoco"]["failures"] == []
    assert rows["mujoco"]["error_max_m"] < 1e-6
    expected = {
        "aborting": "crash: the process crashed with SIGABRT",
        "raising": "crash: RuntimeError: the model has too many bodies",
        "leaving": "crash: the process crashed with exit code 3: licence expired",
        "hanging": f"crash: no answer within {_HANG:g} s",
        "misshapen": "crash: ValueError: the adapter gave time as float64 (3,), not as ",
    }
    for name, reason in expected.items():
        assert rows[name]["verdict"] == "fail"
        assert rows[name]["failures"][0].startswith(reason)
        assert rows[name]["reasons"][0].startswith(reason)
        assert name in ended.out
