"""A compiled model at its reference pose: its names, and what it switches off."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

NOT_YET = "not yet in the scene description"
SWITCHED_OFF = "switched off in MuJoCo, and not in the scene either"
HIGHER = f"terms that are not linear in place and rate are {NOT_YET}"
SWITCHES = {
    "stiffness": "SPRING",
    "springyield": "SPRING",
    "stiffnesspoly": "SPRING",
    "damping": "DAMPER",
    "dampingpoly": "DAMPER",
}
"""Properties of joints and tendons, with the flag that switches each off."""
_CONSTRAINTS = ("LIMIT", "FRICTIONLOSS", "EQUALITY", "CONTACT")
_FLAGS = ("GRAVITY", "SPRING", "DAMPER", "ACTUATION", "CLAMPCTRL", "CONSTRAINT", *_CONSTRAINTS)


class Resolved:
    """A compiled model and its `MjData`, with positions at the reference pose."""

    def __init__(self, model: Any) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        flags = {name: getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}") for name in _FLAGS}
        self.off = {name: bool(model.opt.disableflags & flag) for name, flag in flags.items()}
        """Flags of MuJoCo, true where one switches something off."""
        if self.off["CONSTRAINT"]:
            self.off |= dict.fromkeys(_CONSTRAINTS, True)

    def name(self, kind: str, k: int) -> str:
        """Return the name of an element, or one of its kind and number that no other has."""
        object_type = getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
        if name := mujoco.mj_id2name(self.model, object_type, k):
            return str(name)
        name = f"{kind.lower()} {k}"
        while mujoco.mj_name2id(self.model, object_type, name) >= 0:
            name += "_"
        return name

    def higher(self, kind: str, k: int) -> tuple[str, ...]:
        """Return the attributes of a joint or tendon that state forces that are not linear.

        Args:
            kind: "jnt", "dof" or "tendon".
            k: Index of the element.
        """
        return tuple(
            key.removesuffix("poly")
            for key in ("stiffnesspoly", "dampingpoly", "springyield")
            if not self.off[SWITCHES[key]]
            and np.any(getattr(self.model, f"{kind}_{key}", np.zeros(k + 1))[k])
        )
