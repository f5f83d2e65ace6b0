"""Servos that stand for the actuators of a compiled model at a command of 0."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import Fate

from .parts import Drive
from .resolved import HIGHER, SWITCHED_OFF, Resolved

_IDLE = "exerts nothing without a command, and a scene has none"
_LAST_GROUP = 30
_NO_LAW = [(0.0, 0.0, 0.0, constant) for constant in (True, False)]
_NO_LIMIT = (-np.inf, np.inf)
_NOT_LINEAR = "its force is not linear in place and rate"
_OFF_JOINTS = "it does not act on a joint"


class Actuators:
    """The actuators of a compiled model."""

    def __init__(self, resolved: Resolved) -> None:
        self._model, self._off, self._name = resolved.model, resolved.off, resolved.name
        self._all = range(len(resolved.model.actuator_trntype))

    def drives(self) -> Iterator[Drive | Fate]:
        """Yield each actuator as a servo at a command of 0, or its fate if it cannot be one."""
        for k in self._all if not self._off["ACTUATION"] else ():
            name = self._name("ACTUATOR", k)
            if self._is_off(k):
                yield Fate("actuator", (), "kept", SWITCHED_OFF, True, (name,))
            elif isinstance(drive := self._drive(k), Drive):
                yield drive
            else:
                yield Fate("actuator", (), "dropped", drive, drive != _IDLE, (name,))

    def on_joints(self, key: str) -> Array:
        """Return the armature or damping that they add to joints, whether they are on or off."""
        sums = np.zeros(self._model.njnt)
        for k, value in enumerate(self._own(key)):
            if self._is_on_joint(k):
                sums[self._model.actuator_trnid[k, 0]] += self._gear(k) ** 2 * value
        return sums

    def mechanics(self) -> Iterator[Fate]:
        """Report the armature and damping that actuators have themselves."""
        for k in self._all:
            place = (self._name("ACTUATOR", k),)
            keys = tuple(key for key in ("armature", "damping") if self._own(key)[k])
            if keys and self._is_on_joint(k):
                yield Fate("actuator", keys, "kept", "added to those of its joint", True, place)
            elif keys:
                yield Fate("actuator", keys, "dropped", _OFF_JOINTS, True, place)
            if np.any(self._own("dampingpoly")[k]):
                yield Fate("actuator", ("damping",), "dropped", HIGHER, True, place)

    def _own(self, key: str) -> Array:
        """Return a property of all actuators."""
        return np.asarray(getattr(self._model, f"actuator_{key}"))

    def _is_off(self, k: int) -> bool:
        """Whether an actuator belongs to a group that is switched off."""
        group = int(self._model.actuator_group[k])
        return 0 <= group <= _LAST_GROUP and bool(self._model.opt.disableactuator >> group & 1)

    def _is_on_joint(self, k: int) -> bool:
        return bool(self._model.actuator_trntype[k] <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))

    def _drive(self, k: int) -> Drive | str:
        model, joint, gear = self._model, int(self._model.actuator_trnid[k, 0]), self._gear(k)
        law = self._law(k)
        if law is None:
            return _NOT_LINEAR
        push, stiffness, damping, constant = law
        if not (gear and (push or stiffness or damping)):
            return _IDLE
        if not self._is_on_joint(k):
            return _OFF_JOINTS
        kinds = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
        if model.jnt_type[joint] not in kinds:
            return "the scene description has servos of hinges and sliders alone"
        if not constant:
            return "its activation changes by itself"
        if stiffness < 0 or damping < 0:
            return "it has a negative gain"
        if not (stiffness or damping):
            return "its command nearest to 0 is a push, which no servo of a scene has"
        start = float(model.qpos0[model.jnt_qposadr[joint]])
        return Drive(
            name=self._name("ACTUATOR", k),
            joint=self._name("JOINT", joint),
            stiffness=gear**2 * stiffness,
            damping=gear**2 * damping,
            position=push / (gear * stiffness) - start if stiffness else 0.0,
            velocity=0.0 if stiffness else push / (gear * damping),
            **self._limits(k, joint, abs(gear)),
        )

    def _law(self, k: int) -> tuple[float, float, float, bool] | None:
        """Return what an actuator exerts, before its gear, at commands of 0 in their ranges.

        Returns:
            Push at length and speed 0, stiffness, damping, and whether they are constant; None if
            its force is not linear.
        """
        model = self._model
        controller = model.actuator_gaintype[k] == int(mujoco.mjtGain.mjGAIN_PID)
        linear = controller or model.actuator_gaintype[k] <= int(mujoco.mjtGain.mjGAIN_AFFINE)
        linear = linear and model.actuator_biastype[k] <= int(mujoco.mjtBias.mjBIAS_AFFINE)
        if not linear or model.actuator_dyntype[k] > int(mujoco.mjtDyn.mjDYN_FILTEREXACT):
            return None
        commands = self._commands(k)
        act, constant = commands[0], True
        if model.actuator_dyntype[k]:
            act = _nearest_to_0(model.actuator_actlimited[k], model.actuator_actrange[k])
            constant = commands[0] == 0
        gain, bias = model.actuator_gainprm[k], model.actuator_biasprm[k]
        if model.actuator_biastype[k] == mujoco.mjtBias.mjBIAS_NONE:
            bias = 0.0 * bias
        if controller:  # it has some of the commands of a place, a rate and a force, in this order
            weights = (-bias[1], -bias[2], 1.0)
            own = [each for j, each in enumerate(weights) if model.actuator_ctrlspec[k] >> j & 1]
            act, gain = 1.0, [np.dot(own, commands), 0.0, 0.0]
        elif model.actuator_gaintype[k] == mujoco.mjtGain.mjGAIN_FIXED:
            gain = [gain[0], 0.0, 0.0]
        push, stiffness, damping = (float(act * gain[j] + bias[j]) for j in range(3))
        return push, 0.0 - stiffness, 0.0 - damping, constant

    def _gear(self, k: int) -> float:
        """Return the gear of an actuator on a hinge or slider, the first of its outputs."""
        return float(self._model.actuator_gear[self._model.actuator_outadr[k], 0])

    def _commands(self, k: int) -> list[float]:
        """Return the commands of an actuator that are nearest to 0 in their ranges."""
        model, clamps = self._model, not self._off["CLAMPCTRL"]
        first, count = int(model.actuator_ctrladr[k]), int(model.actuator_ctrlnum[k])
        return [
            _nearest_to_0(clamps and model.actuator_ctrllimited[c], model.actuator_ctrlrange[c])
            for c in range(first, first + count)
        ]

    def _limits(self, k: int, joint: int, gear: float) -> dict[str, Any]:
        """Return the torque limit of an actuator, or why it is not kept, as fields of `Drive`."""
        model = self._model
        own = gear * model.actuator_forcerange[k] if model.actuator_forcelimited[k] else _NO_LIMIT
        whole = model.jnt_actfrcrange[joint] if model.jnt_actfrclimited[joint] else _NO_LIMIT
        if whole is not _NO_LIMIT and self._shares(k, joint):
            return {"limit_loss": "several actuators share the limit of their joint"}
        low, high = max(own[0], whole[0]), min(own[1], whole[1])
        if np.isinf(high) and np.isinf(low):
            return {}
        if not 0 < high == -low:
            return {"limit_loss": f"{low:g} to {high:g} is not symmetric"}
        return {"limit": float(high)}

    def _shares(self, k: int, joint: int) -> bool:
        """Whether other actuators exert something on the joint of one, too."""
        return any(
            self._law(other) not in _NO_LAW
            for other in self._all
            if other != k
            and self._model.actuator_trnid[other, 0] == joint
            and self._is_on_joint(other)
            and not self._is_off(other)
        )


def _nearest_to_0(limited: bool, span: Any) -> float:
    return float(np.clip(0.0, *span)) if limited else 0.0
