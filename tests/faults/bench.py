"""The scenes in which faults are planted: built-in ones, cut short, at settings that are quick."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from mbds_xsim import registry
from mbds_xsim.choice import Choice, Contender
from mbds_xsim.engine import Settings
from mbds_xsim.result import Validation
from mbds_xsim.scene import Scene
from mbds_xsim.validate import validate_with_evidence

from .planting import Fault, planted

__all__ = ["ENGINES", "SCENES", "checked", "scene_of"]

ENGINES = ("mujoco", "pybullet", "dart", "exudyn")

# Recorded frames: a second, or what is enough for the faults that are planted there.
SCENES = {"3pendulum": 50, "2ladder": 25, "workbench": 16}

# Method, steps a frame and options at which the control passes.
_SETTINGS: dict[tuple[str, str], tuple[str, int, dict[str, float]]] = {
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
    ("workbench", "dart"): ("semi-implicit-euler", 20, {"error_reduction": 0.8}),
    # At longer steps Newton's method fails on the fast start; at shorter ones, or with a Jacobian
    # that is kept, what it leaves shows beside the small difference that a step makes.
    ("workbench", "exudyn"): ("trapezoidal", 64, {"modified_newton": False}),
}


@dataclass(frozen=True)
class _Quick(Choice):
    def contenders(self, scene: Scene) -> tuple[list[Contender], dict[str, str]]:
        found = []
        for engine in self.engines:
            method, count, options = _SETTINGS[scene.name, engine]
            settings = Settings(method, scene.clock.frame / count, options)
            found.append(Contender(engine, "matched", settings))
        return found, {}


def scene_of(name: str) -> Scene:
    """Load a scene and cut it short."""
    scene = registry.load_scene(name)
    clock = msgspec.structs.replace(scene.clock, steps=SCENES[name])
    return msgspec.structs.replace(scene, clock=clock)


def checked(
    scene: str,
    fault: Fault | None = None,
    engine: str = "",
    *,
    engines: tuple[str, ...] = ENGINES,
    readback: bool = False,
) -> Validation:
    """Validate a scene with a fault in one engine, on its motion alone or its native model too."""
    with planted(fault, engine):
        return validate_with_evidence(
            scene_of(scene), choice=_Quick(engines), workers=0, readback=readback
        )[0]
