"""Studies of trade-offs that take little time, for the tests of what they measure."""

from __future__ import annotations

from typing import Any

import msgspec

from mbds_xsim import tradeoff
from mbds_xsim.measure.runner import Store
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.studies.tradeoff import Measurement, Tradeoff

ROW = Measurement(
    key="", scene="particlecar", engine="pybullet", version="1", method="semi-implicit-euler",
    variation="", options={}, steps_per_frame=1, step_s=0.02, trajectory=1, seed=0,
    machine="", limit_s=1.0, kind="done", wall_s=(1.0,), cpu_s=(1.0,),
)  # fmt: skip


def studied(scene: Scene, engines: str = "mujoco,exudyn", **how: Any) -> Tradeoff:
    return tradeoff(scene, engines=engines.split(","), **({"starts": 1, "workers": 0} | how))


def store(scene: Scene) -> Store[Measurement]:
    return Store.of("tradeoff", scene.name, Measurement)


def curve_of(study: Tradeoff, name: str) -> Any:
    return next(curve for curve in study.curves if curve.name == name)


def shortened(name: str, steps: int) -> Scene:
    """Load a scene of so many frames."""
    scene = registry.load_scene(name)
    return msgspec.structs.replace(scene, clock=msgspec.structs.replace(scene.clock, steps=steps))
