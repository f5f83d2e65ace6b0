"""Servos that stand for the actuators of a compiled model at a command of 0."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import Fate

from .parts import Drive
from .ties import HIGHER, SWITCHED_OFF, element_name

_IDLE = "exerts nothing without a command, and a scene has none"
_LAST_GROUP = 30
_NO_LAW = [(0.0, 0.0, 0.0, constant) for constant in (True, False)]
_NO_LIMIT = (-np.inf, np.inf)
_NOT_LINEAR = "its force is not linear in place and rate"


def drives(mujoco: Any, model: Any) -> Iterator[Drive | Fate]:
    """Yield each actuator as a servo at a command of 0, or its fate if it cannot be one."""
    flags = mujoco.mjtDisableBit
    if model.opt.disableflags & flags.mjDSBL_ACTUATION:
        return
    clamps = not model.opt.disableflags & flags.mjDSBL_CLAMPCTRL
    for k in range(len(model.actuator_trntype)):
        name = element_name(mujoco, model, "ACTUATOR", k)
        if _switched_off(model, k):
            yield Fate("actuator", (), "kept", SWITCHED_OFF, True, (name,))
            continue
        drive_or_text = _drive(mujoco, model, k, clamps=clamps)
        if isinstance(drive_or_text, Drive):
            yield drive_or_text
        else:
            yield Fate("actuator", (), "dropped", drive_or_text, drive_or_text != _IDLE, (name,))


def on_joints(mujoco: Any, model: Any, key: str) -> Array:
    """Return the armature or damping that actuators add to joints, whether they are on or off.

    Args:
        mujoco: The module.
        model: The compiled model.
        key: "armature" or "damping".
    """
    sums = np.zeros(model.njnt)
    for k, value in enumerate(_own(model, key)):
        if model.actuator_trntype[k] <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            sums[model.actuator_trnid[k, 0]] += _gear(model, k) ** 2 * value
    return sums


def mechanics_of_drives(mujoco: Any, model: Any) -> Iterator[Fate]:
    """Report the armature and damping that actuators have themselves."""
    for k in range(len(model.actuator_trntype)):
        place = (element_name(mujoco, model, "ACTUATOR", k),)
        keys = tuple(key for key in ("armature", "damping") if _own(model, key)[k])
        if keys and model.actuator_trntype[k] <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            yield Fate("actuator", keys, "kept", "added to those of its joint", True, place)
        elif keys:
            yield Fate("actuator", keys, "dropped", "it does not act on a joint", True, place)
        if np.any(_own(model, "dampingpoly")[k]):
            yield Fate("actuator", ("damping",), "dropped", HIGHER, True, place)


def _own(model: Any, key: str) -> Array:
    """Return a property of all actuators."""
    return np.asarray(getattr(model, f"actuator_{key}"))


def _switched_off(model: Any, k: int) -> bool:
    """Whether an actuator belongs to a group that is switched off."""
    group = int(model.actuator_group[k])
    return 0 <= group <= _LAST_GROUP and bool(model.opt.disableactuator >> group & 1)


def _drive(mujoco: Any, model: Any, k: int, *, clamps: bool) -> Drive | str:
    joint, gear = int(model.actuator_trnid[k, 0]), _gear(model, k)
    law = _law(mujoco, model, k, clamps=clamps)
    if law is None:
        return _NOT_LINEAR
    push, stiffness, damping, constant = law
    if not (gear and (push or stiffness or damping)):
        return _IDLE
    if model.actuator_trntype[k] > int(mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        return "it does not act on a joint"
    kinds = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    if model.jnt_type[joint] not in kinds:
        return "the scene description has servos of hinges and sliders alone"
    if not constant:
        return "its activation changes by itself"
    if stiffness < 0 or damping < 0 or not (stiffness or damping):
        return "it has a negative gain, or none"
    start = float(model.qpos0[model.jnt_qposadr[joint]])
    shared = bool(model.jnt_actfrclimited[joint]) and any(
        _law(mujoco, model, other, clamps=clamps) not in _NO_LAW
        for other in range(len(model.actuator_trntype))
        if other != k
        and model.actuator_trnid[other, 0] == joint
        and model.actuator_trntype[other] <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        and not _switched_off(model, other)
    )
    return Drive(
        name=element_name(mujoco, model, "ACTUATOR", k),
        joint=element_name(mujoco, model, "JOINT", joint),
        stiffness=gear**2 * stiffness,
        damping=gear**2 * damping,
        position=push / (gear * stiffness) - start if stiffness else 0.0,
        velocity=0.0 if stiffness else push / (gear * damping),
        **_limits(model, k, joint, abs(gear), shared=shared),
    )


def _law(
    mujoco: Any, model: Any, k: int, *, clamps: bool
) -> tuple[float, float, float, bool] | None:
    """Return what an actuator exerts, before its gear, at commands of 0 in their ranges.

    Returns:
        Push at length and speed 0, stiffness, damping, and whether they are constant; None if its
        force is not linear.
    """
    controller = model.actuator_gaintype[k] == int(mujoco.mjtGain.mjGAIN_PID)
    linear = controller or model.actuator_gaintype[k] <= int(mujoco.mjtGain.mjGAIN_AFFINE)
    linear = linear and model.actuator_biastype[k] <= int(mujoco.mjtBias.mjBIAS_AFFINE)
    if not linear or model.actuator_dyntype[k] > int(mujoco.mjtDyn.mjDYN_FILTEREXACT):
        return None
    commands = _commands(model, k, clamps=clamps)
    act, constant = _activation(model, k, commands[0])
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


def _gear(model: Any, k: int) -> float:
    """Return the gear of an actuator on a hinge or slider, the first of its outputs."""
    return float(model.actuator_gear[model.actuator_outadr[k], 0])


def _commands(model: Any, k: int, *, clamps: bool) -> list[float]:
    """Return the commands of an actuator that are nearest to 0 in their ranges."""
    first, count = int(model.actuator_ctrladr[k]), int(model.actuator_ctrlnum[k])
    return [
        _within(0.0, clamps and model.actuator_ctrllimited[c], model.actuator_ctrlrange[c])
        for c in range(first, first + count)
    ]


def _limits(model: Any, k: int, joint: int, gear: float, *, shared: bool) -> dict[str, Any]:
    """Return the torque limit of an actuator, or why it is not kept, as fields of `Drive`.

    Args:
        model: The compiled model.
        k: Index of the actuator.
        joint: Index of its joint.
        gear: Size of its gear.
        shared: Whether the limit of the joint holds for several actuators together.
    """
    own = gear * model.actuator_forcerange[k] if model.actuator_forcelimited[k] else _NO_LIMIT
    whole = model.jnt_actfrcrange[joint] if model.jnt_actfrclimited[joint] else _NO_LIMIT
    if shared:
        return {"limit_loss": "several actuators share the limit of their joint"}
    low, high = max(own[0], whole[0]), min(own[1], whole[1])
    if np.isinf(high) and np.isinf(low):
        return {}
    if not 0 < high == -low:
        return {"limit_loss": f"{low:g} to {high:g} is not symmetric"}
    return {"limit": float(high)}


def _activation(model: Any, k: int, command: float) -> tuple[float, bool]:
    """Return the gain's input at a command, and whether it stays constant."""
    if not model.actuator_dyntype[k]:
        return command, True
    return _within(0.0, model.actuator_actlimited[k], model.actuator_actrange[k]), command == 0


def _within(value: float, limited: bool, span: Any) -> float:
    return float(np.clip(value, *span)) if limited else value
