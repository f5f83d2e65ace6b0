"""The loops that the adapters' speed is held against do what the adapters do."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.matched import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene

_ROOT = Path(__file__).parents[1]
_SAME = 1e-12


@pytest.fixture
def loops(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(_ROOT))
    return importlib.import_module("benchmarks.lean_loops")


# The cube comes down before its last frame, so that steps near the ground are among them.
@pytest.mark.parametrize(
    ("scene", "frames"), [("6pendulum", 8), ("3ladder", 8), ("simplecubli", 60)]
)
def test_the_lean_loop_makes_the_adapters_trajectory(
    loops: ModuleType, scene: str, frames: int, engine: str
) -> None:
    description = load_scene(scene)
    adapter = load_adapter(engine)
    batch = draw_batch(description, [1]).truncated(frames)
    with adapter.open(description, settings_for(description, adapter, "matched")) as run:
        lean = loops.LEAN[engine](run, batch)
        assert loops.apart(Mechanism.of(description), run, batch, lean) < _SAME


def test_the_lean_loop_applies_the_inputs(loops: ModuleType, engine: str) -> None:
    description = load_scene("simplecubli")
    adapter = load_adapter(engine)
    batch = draw_batch(description, [1]).truncated(5)
    with adapter.open(description, settings_for(description, adapter, "matched")) as run:
        lean = loops.LEAN[engine](run, batch)
        lean.roll()
        with_inputs = lean.bodies()
        for inputs in (batch.force, batch.torque):
            inputs[:] = 0.0
        lean = loops.LEAN[engine](run, batch)
        lean.roll()
        without = lean.bodies()
    assert np.abs(with_inputs.velocity - without.velocity).max() > 1e-4
    assert np.abs(with_inputs.angular_velocity - without.angular_velocity).max() > 1e-2


@pytest.mark.parametrize("interval", [0, 2])
def test_the_lean_loop_knows_which_model_is_used(loops: ModuleType, interval: int) -> None:
    """MuJoCo's model without spin, or the whole one where rods bend too far."""
    description = load_scene("3ladder")
    adapter = load_adapter("mujoco")
    matched = settings_for(description, adapter, "matched")
    settings = replace(matched, options={**matched.options, "spin": False})
    batch = draw_batch(description, [interval]).truncated(60)
    with adapter.open(description, settings) as run:
        lean = loops.LEAN["mujoco"](run, batch)
        assert loops.apart(Mechanism.of(description), run, batch, lean) < _SAME


def test_one_call_of_exudyns_solver_makes_nearly_the_same_trajectory(loops: ModuleType) -> None:
    """But not the same: it starts no frame anew where the loads jump."""
    description = load_scene("3ladder")
    adapter = load_adapter("exudyn")
    batch = draw_batch(description, [1]).truncated(10)
    with adapter.open(description, settings_for(description, adapter, "matched")) as run:
        one_call = loops.exudyn_in_one_call(run, batch)
        one_call.roll()
        made, told = one_call.bodies(), run.rollout(batch)
    error = np.abs(made.position - told.position[0, 1:]).max()
    assert 1e-9 < error < 1e-3
