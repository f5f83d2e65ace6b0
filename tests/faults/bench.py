"""Validation of scenes with a fault in one engine, at settings that are quick."""

from __future__ import annotations

import functools
from typing import Any

from mbds_xsim.base.isolate import HERE
from mbds_xsim.measure.result import Validation
from mbds_xsim.simulate.choice import Choice, Matched, settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.studies.validate import validate_with_evidence

from .planting import Fault, planted
from .scenes import scene_of

__all__ = ["ENGINES", "able", "checked", "told"]

ENGINES = ("mujoco", "pybullet", "dart", "exudyn")

# Method, steps a frame and options at which the control passes, where the matched ones are slow.
_SETTINGS: dict[tuple[str, str], tuple[str, int, dict[str, Any]]] = {
    ("3pendulum", "mujoco"): ("RK4", 8, {}),
    ("3pendulum", "pybullet"): ("semi-implicit-euler", 200, {}),
    ("3pendulum", "dart"): ("forward-dynamics-RK4", 8, {}),
    ("3pendulum", "exudyn"): ("trapezoidal", 16, {}),
    ("2ladder", "mujoco"): ("RK4", 32, {}),
    ("2ladder", "pybullet"): ("semi-implicit-euler", 40, {}),
    ("2ladder", "dart"): ("semi-implicit-euler", 20, {"error_reduction": 0.8}),
    ("2ladder", "exudyn"): ("trapezoidal", 8, {}),
    ("workbench", "mujoco"): ("Euler", 40, {}),
    ("workbench", "pybullet"): ("semi-implicit-euler", 20, {}),
    ("workbench with stops", "pybullet"): ("semi-implicit-euler", 40, {"erp": 1e-3}),
    ("workbench", "dart"): ("semi-implicit-euler", 20, {"error_reduction": 0.8}),
    # Errors of a kept Jacobian would hide the small difference that a step makes.
    ("workbench", "exudyn"): ("generalised-alpha", 16, {"modified_newton": False}),
    ("ballscroll with another ball", "mujoco"): ("RK4", 8, {"impact_steps": 1}),
    ("ballscroll with another ball", "pybullet"): (
        "semi-implicit-euler",
        160,
        {"solver_iterations": 50},
    ),
    ("ballscroll with another ball", "dart"): (
        "semi-implicit-euler",
        200,
        {"collision_detector": "ode", "friction_solver": "nsgs"},
    ),
    ("ballscroll with another ball", "exudyn"): (
        "trapezoidal",
        32,
        {
            "modified_newton": False,
            "slip_speed": 1e-4,
            "impact_steps": 48,
            "contact_substeps": 80,
        },
    ),
    ("simplecubli for 3 s", "dart"): (
        "semi-implicit-euler",
        120,
        {"collision_detector": "ode", "friction_solver": "nsgs"},
    ),
    ("simplecubli for 3 s", "exudyn"): (
        "trapezoidal",
        16,
        {"contact_substeps": 5, "impact_steps": 12, "slip_speed": 0.01},
    ),
    ("simplecubli set down", "pybullet"): ("semi-implicit-euler", 40, {"solver_iterations": 50}),
    ("simplecubli set down", "dart"): (
        "semi-implicit-euler",
        20,
        {"collision_detector": "ode", "friction_solver": "nsgs"},
    ),
}


@functools.cache
def _quick(name: str, engine: str) -> Matched:
    """Return quick settings, or the matched ones of the scene that this one was made from."""
    for known in (name, name := name.partition(" with ")[0]):
        if (known, engine) in _SETTINGS:
            return Matched(*_SETTINGS[known, engine])
    scene = load_scene(name.split()[0])
    settings = settings_for(scene, load_adapter(engine), "matched")
    return Matched(settings.method, settings.substeps(scene.clock.frame), dict(settings.options))


@functools.cache
def able(scene: str) -> tuple[str, ...]:
    """Name the engines that have everything a scene needs."""
    ways = {name: load_adapter(name).refusals for name in ENGINES}
    return tuple(n for n in ENGINES if not ways[n](scene_of(scene), _quick(scene, n).method))


def checked(
    scene: str,
    fault: Fault | None = None,
    engine: str = "",
    *,
    engines: tuple[str, ...] = ENGINES,
    readback: bool = False,
    frames: int | None = None,
) -> Validation:
    """Validate a scene with a fault in one engine, on its motion alone or its native model too."""
    matched = {name: _quick(scene, name) for name in engines if name in able(scene)}
    choice = Choice(tuple(matched), settings={"matched": matched})
    with planted(fault.change if fault else None, engine):
        return validate_with_evidence(
            scene_of(scene, frames), choice=choice, conduct=HERE, readback=readback
        )[0]


def told(scene: str, fault: Fault, engine: str) -> list[str]:
    """Return the differences that read-back reports; one frame of motion is enough for it."""
    validation = checked(scene, fault, engine, engines=(engine,), readback=True, frames=1)
    reasons = (reason.partition("read-back: ") for reason in validation.engines[0].reasons)
    return [message for before, _, message in reasons if not before]
