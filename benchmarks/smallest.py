"""How small a body each engine can move: `python benchmarks/smallest.py`.

Masses and moments of inertia are bisected, from 1 down to what scene files can name, on a body
that falls on a slider and one that turns on a hinge through its centre of mass. A body is moved
rightly where the engine loads it, holds what the scene says, and moves it as one of 1 kg and
1 kg·m². The limits that adapters declare are left out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable

import numpy as np

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene, Torque
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.registry import engine_names, load_adapter

_LEAST = 1e-29
_HALVINGS = 20


def falling(mass: float) -> Scene:
    """Give a body that falls on a slider; its moments of inertia are 1 kg·m²."""
    body = Body("body", inertia=Inertia(mass, (1.0, 1.0, 1.0)))
    slider = Joint("joint", "slider", "world", "body", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return Scene("falling", (body,), 1.0, joints=(slider,), clock=Clock(0.02, 10))


def turning(moment: float) -> Scene:
    """Give a body that is turned about its centre of mass; its mass is 1 kg."""
    body = Body("body", inertia=Inertia(1.0, (moment, moment, moment)))
    hinge = Joint("joint", "hinge", "world", "body", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    torque = Torque("joint", (moment,))
    joints, torques = (hinge,), (torque,)
    return Scene("turning", (body,), 1.0, joints=joints, torques=torques, clock=Clock(0.02, 10))


def moved(adapter: Adapter, scene: Scene) -> float:
    """Give the last coordinate: height [m] or turn [rad]; NaN where the engine has other bodies."""
    preset, batch = adapter.settings(scene, "matched"), draw_batch(scene, [0])
    settings = Settings(preset.method, 0.001, preset.options)
    with adapter.load(scene, settings) as run:
        held = run.readback(batch)
        trajectory = run.rollout(batch)
    if readback.compare(Mechanism.of(scene), batch, settings, held):
        return math.nan
    return float(trajectory.position[0, -1, 0, 2] + trajectory.orientation[0, -1, 0, 2])


def rightly(adapter: Adapter, like: Scene, scene: Scene) -> bool:
    """Tell in a process of its own, which may crash, whether a body moves as another does."""
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        try:
            same = np.isclose(moved(adapter, scene), moved(adapter, like), rtol=1e-6)
        except Exception:  # whatever an engine raises, it does not move the body
            same = np.False_
        os._exit(0 if same else 1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def smallest(adapter: Adapter, make: Callable[[float], Scene]) -> float:
    """Bisect the smallest number with which an engine moves a body rightly."""
    if rightly(adapter, make(1.0), make(_LEAST)):
        return _LEAST
    wrong, right = math.log(_LEAST), 0.0
    for _ in range(_HALVINGS):
        middle = (wrong + right) / 2
        if rightly(adapter, make(1.0), make(math.exp(middle))):
            right = middle
        else:
            wrong = middle
    return math.exp(right)


def main() -> None:
    """Print a line for each engine."""
    for name in engine_names():
        adapter = load_adapter(name)
        mass, moment = smallest(adapter, falling), smallest(adapter, turning)
        print(f"{name:10} mass {mass:.4g} kg, moment of inertia {moment:.4g} kg·m²", flush=True)


if __name__ == "__main__":
    main()
