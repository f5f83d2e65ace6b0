"""Versions that name stored results are raised whenever the results change."""

from __future__ import annotations

import dataclasses

import numpy as np

from mbds_xsim.base import versions
from mbds_xsim.checks.audit import audit
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry, rounding
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.timed import simulate
from tests.golden import check_golden, shadow

_SCENES = ("2pendulum", "2ladder", "balldrop")
_FRAMES = 5


def _drawn(name: str) -> tuple[Scene, Batch]:
    scene = registry.load_scene(name)
    return scene, draw_batch(scene, range(3)).truncated(_FRAMES)


def _shadows(motion: Trajectory | Batch, *names: str) -> dict[str, float]:
    return {name: shadow(getattr(motion, name)) for name in names}


def test_golden_physics() -> None:
    figures = {}
    for name in _SCENES:
        scene, batch = _drawn(name)
        for key, value in _shadows(batch, "position", "velocity", "force").items():
            figures[f"{name} start {key}"] = value
        truth = solve(scene, batch, cache=False)
        for key, value in _shadows(truth, "position", "orientation").items():
            figures[f"{name} {key}"] = value

    check_golden("physics", versions.PHYSICS, figures)


def test_golden_checks() -> None:
    figures = {}
    method = registry.load_adapter("mujoco").methods["RK4"]
    for name in _SCENES:
        scene, batch = _drawn(name)
        truth = solve(scene, batch, cache=False)
        shaken = 1e-4 * np.sin(np.arange(truth.position.size)).reshape(truth.position.shape)
        motion = dataclasses.replace(truth, position=truth.position + shaken)
        for result in audit(scene, batch, motion, method, step=scene.clock.frame, contact_time=0.0):
            figures[f"{name} {result.check}"] = shadow(result.series)

    check_golden("checks", versions.CHECKS, figures, rtol=1e-6)


def test_golden_adapter(adapter: Adapter) -> None:
    """Single precision gives other last bits on other processors, in each of a hundred numbers."""
    figures, method = {}, next(iter(adapter.methods.values()))
    rounded = rounding.step_error(method, 20 * _FRAMES)
    for name in _SCENES:
        scene, batch = _drawn(name)
        settings = Settings(method.name, scene.clock.frame / 20)
        if adapter.refusals(scene, settings.method):
            continue
        motion = simulate(scene, batch, adapter.name, settings).trajectory
        for key, value in _shadows(motion, "position", "angular_velocity").items():
            figures[f"{name} {key}"] = value

    about = f"adapter {adapter.name}", adapter.revision, figures
    check_golden(*about, rtol=max(1e-8, rounded), atol=max(1e-10, 100 * rounded))
