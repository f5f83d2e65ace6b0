"""Faults inside adapters, which no scene, settings or recording could cause."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from typing import Any
from unittest import mock

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.scene.mechanism import WORLD_INDEX

__all__ = [
    "axle_damping", "force_off_center", "friction_box", "joint_damping", "motors_left_on",
    "no_reaction", "rolling_resistance", "slippery_wheel", "speed_limit",
]  # fmt: skip

_OFFSET = [0.0, 0.0, 0.05]
"""Offset of forces from centres of mass [m]."""
_DAMPING = 0.01
"""Damping of joints [N·m·s]."""
_DART_DAMPING = """
for joint in joints.values():
    for k in range(joint.getNumDofs()):
        joint.setDampingCoefficient(k, {})
"""
_FASTEST = 100.0
"""Bullet's own limit of joint rates [rad/s]."""
_DART_LIMIT = f"""
for joint in joints.values():
    if joint.getNumDofs() == 1:
        joint.setVelocityUpperLimit(0, {_FASTEST})
        joint.setLimitEnforcement(True)
"""


_WHEEL, _SLIPPERY = 1, 0.40
"""Body that has only the first of all spheres, and its friction."""
_ROLLING = 0.1
"""Rolling resistance as a lever of the normal force [m]."""


def motors_left_on(_engine: str) -> AbstractContextManager[object]:
    """Leave PyBullet's joint motors as `createMultiBody` makes them."""
    return mock.patch.object(_adapter("pybullet.model").Multibodies, "_switch_motor_off")


def joint_damping(engine: str) -> AbstractContextManager[object]:
    """Let every joint of MuJoCo or DART have some damping, as their model files often do."""
    return {"mujoco": _damped_mujoco, "dart": _damped_dart}[engine](_DAMPING)


def axle_damping(engine: str) -> AbstractContextManager[object]:
    """Let every axle have a tenth of that of `joint_damping`."""
    return {"mujoco": _damped_mujoco, "dart": _damped_dart}[engine](_DAMPING / 10.0)


def force_off_center(engine: str) -> AbstractContextManager[object]:
    """Push bodies off their centres of mass."""
    return {"pybullet": _pybullet, "dart": _dart, "exudyn": _exudyn}[engine]()


def no_reaction(engine: str) -> AbstractContextManager[object]:
    """Let hinge torques act on the child alone."""
    one_sided = {
        "mujoco": _one_sided_mujoco,
        "mujoco-warp": _one_sided_mujoco,
        "pybullet": _one_sided_pybullet,
        "dart": _one_sided_dart,
        "exudyn": _one_sided_exudyn,
        "pinocchio": _one_sided_pinocchio,
        "drake": _one_sided_drake,
    }
    return one_sided[engine]()


def _pybullet() -> AbstractContextManager[object]:
    loads = _adapter("pybullet.loads").StepLoads
    push = loads._push

    def push_beside(self: Any, body: int, force: Any, point: Any) -> None:
        push(self, body, force, point + np.array(_OFFSET))

    return mock.patch.object(loads, "_push", push_beside)


def _dart() -> AbstractContextManager[object]:
    def move(self: Any, _force: Any, _torque: Any) -> None:
        self.forces = [(_beside(apply), value) for apply, value in self.forces]

    return _with_more(_adapter("dart.stepping").FrameLoads, "hold", move)


def _beside(apply: Any) -> Any:
    return lambda force: apply(force, _OFFSET)


def _exudyn() -> AbstractContextManager[object]:
    bodies = _adapter("exudyn.model")
    listing = bodies.loads_listing

    def listed_beside(mechanism: Any) -> Iterator[str]:
        for line in listing(mechanism):
            if line.startswith("forces"):
                line = line.replace("centres", "bodies")
                yield line.replace("])", f"], localPosition={_OFFSET})")
            else:
                yield line

    return mock.patch.object(bodies, "loads_listing", listed_beside)


def _damped_mujoco(damping: float) -> AbstractContextManager[object]:
    adapter = _adapter("mujoco.run")
    text = adapter.indented

    def text_with_damping(root: Any) -> Any:
        for flag in root.iter("flag"):
            flag.attrib.pop("damper", None)
        for joint in root.iter("joint"):
            joint.set("damping", str(damping))
        return text(root)

    return mock.patch.object(adapter, "indented", text_with_damping)


def _damped_dart(damping: float) -> AbstractContextManager[object]:
    adapter = _adapter("dart.run")
    listing = adapter.build_listing
    return mock.patch.object(
        adapter, "build_listing", lambda *args: listing(*args) + _DART_DAMPING.format(damping)
    )


def _one_sided_mujoco() -> AbstractContextManager[object]:
    """Drive a point of the child instead of the joint."""
    model = _adapter("mujoco.model")

    def change(actuators: Any, bodies: Any, mechanism: Any) -> None:
        for motor, hinge in zip(actuators, mechanism.hinges, strict=True):
            if motor.attrib.pop("refsite", None) is None:
                del motor.attrib["joint"]
                site = model._site(bodies[hinge.child], f"{hinge.name} hub", hinge.in_child)
                motor.set("site", site)
                motor.set("gear", model.numbers((0.0, 0.0, 0.0, *hinge.axis)))

    return _with_more(model, "_motors", change)


def _one_sided_pybullet() -> AbstractContextManager[object]:
    """Take the reaction back from the parent."""

    def take_back(self: Any, _force: Any, torque: Any, reading: Any) -> None:
        state = self._model.states(reading)
        for hinge, value in zip(self._hinges, torque, strict=True):
            if hinge.parent != WORLD_INDEX and value:
                back = value * rotation.rotate(state.native[hinge.parent], hinge.axis)
                self._apply_torque(*self._address(hinge.parent), back.tolist(), self._in_world)

    return _with_more(_adapter("pybullet.loads").StepLoads, "apply", take_back)


def _one_sided_dart() -> AbstractContextManager[object]:
    """Take the reaction back from the parent."""
    loads = _adapter("dart.stepping").FrameLoads
    hold = loads.hold

    def hold_one_sided(self: Any, force: Any, torque: Any) -> None:
        # Only a force, however small, clears the torque of the previous step.
        hold(self, np.where(force == 0.0, np.finfo(float).tiny, force), torque)
        for hinge, value in zip(self._model.mechanism.hinges, torque, strict=True):
            if hinge.parent != WORLD_INDEX:
                parent = self._model.bodies[hinge.parent]
                self.others.append(partial(parent.addExtTorque, value * hinge.axis))

    return mock.patch.object(loads, "hold", hold_one_sided)


def _one_sided_exudyn() -> AbstractContextManager[object]:
    run = _adapter("exudyn.run").ExudynRun
    load = run._load

    def load_one_sided(self: Any, force: Any, torque: Any) -> None:
        self._names["torques"] = [(child, None) for child, _ in self._names["torques"]]
        load(self, force, torque)

    return mock.patch.object(run, "_load", load_one_sided)


def _one_sided_pinocchio() -> AbstractContextManager[object]:
    def replace(self: Any, batch: Any, rows: Any, frame: int) -> None:
        turning = np.zeros_like(batch.force[rows, frame])
        for k, hinge in enumerate(self._mechanism.hinges):
            turning[:, hinge.child] += batch.torque[rows, frame][:, [k]] * hinge.axis
        self._dynamics.torque, self._dynamics.turning = 0.0, turning

    return _with_more(_adapter("pinocchio.run").PinocchioRun, "_hold", replace)


def _one_sided_drake() -> AbstractContextManager[object]:
    """Treat all torques as loops' torques, which Drake applies to bodies, without the parent."""

    def replace(self: Any, *_: Any) -> None:
        self._driven, self._driven_at = [], []
        hinges = enumerate(self._mechanism.hinges)
        self._looped = [(k, dataclasses.replace(each, parent=WORLD_INDEX)) for k, each in hinges]

    return _with_more(_adapter("drake.run").DrakeRun, "__init__", replace)


def _with_more(place: Any, name: str, more: Callable[..., None]) -> AbstractContextManager[object]:
    """Let a function or method call `more` when it has finished."""
    own = getattr(place, name)

    def both(*args: Any) -> None:
        own(*args)
        more(*args)

    return mock.patch.object(place, name, both)


def _adapter(module: str) -> Any:
    return importlib.import_module(f"mbds_xsim_adapters.{module}")


def friction_box(engine: str) -> AbstractContextManager[object]:
    """Bound friction along x and along y, as Bullet and DART do by default."""
    return {"pybullet": _pybullet_box, "dart": _dart_box}[engine]()


def speed_limit(engine: str) -> AbstractContextManager[object]:
    """Keep the limit of joint rates in PyBullet, or set the same one in DART."""
    return {"pybullet": _slow_pybullet, "dart": _slow_dart}[engine]()


def slippery_wheel(engine: str) -> AbstractContextManager[object]:
    """Give the first wheel less friction than the others have."""
    slippery = {"mujoco": _mujoco_wheel, "pybullet": _pybullet_wheel}
    return slippery[engine]()


def rolling_resistance(_engine: str) -> AbstractContextManager[object]:
    """Let PyBullet's spheres resist rolling; MuJoCo's rows of rolling are too soft to be felt."""
    return _pybullet_pairs(lambda _: {"rollingFriction": _ROLLING})


def _mujoco_wheel() -> AbstractContextManager[object]:
    adapter = _adapter("mujoco.run")
    text = adapter.indented

    def changed(root: Any) -> Any:
        next(root.iter("pair")).set("friction", f"{_SLIPPERY} {_SLIPPERY} 0 0 0")
        return text(root)

    return mock.patch.object(adapter, "indented", changed)


def _pybullet_wheel() -> AbstractContextManager[object]:
    return _pybullet_pairs(lambda body: {"lateralFriction": _SLIPPERY} if body == _WHEEL else {})


def _pybullet_pairs(
    change: Callable[[int], dict[str, float]],
) -> AbstractContextManager[object]:
    """Give bodies with spheres other coefficients."""

    def replace(self: Any, number: int, link: int, body: int) -> None:
        if body in self._body:
            self._client.build("changeDynamics", number, link, **change(body))

    return _with_more(_adapter("pybullet.contact").BulletContact, "set_pair", replace)


def _pybullet_box() -> AbstractContextManager[object]:
    def replace(self: Any, _law: Any, _step: float) -> None:
        self._client.build("setPhysicsEngineParameter", enableConeFriction=0)

    return _with_more(_adapter("pybullet.contact").BulletContact, "_set_solver", replace)


def _dart_box() -> AbstractContextManager[object]:
    adapter = _adapter("dart")
    statements = adapter.contact_statements
    return mock.patch.object(
        adapter, "contact_statements", lambda *args: statements(*args[:-1], "dantzig")
    )


def _slow_pybullet() -> AbstractContextManager[object]:
    return mock.patch.object(_adapter("pybullet.model"), "SPEED_CAP", _FASTEST)


def _slow_dart() -> AbstractContextManager[object]:
    adapter = _adapter("dart.run")
    listing = adapter.build_listing
    return mock.patch.object(adapter, "build_listing", lambda *args: listing(*args) + _DART_LIMIT)
