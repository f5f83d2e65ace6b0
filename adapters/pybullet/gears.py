"""Gears: joints that follow others, and rotors, which a joint turns by a gear.

Bullet's joints have no inertia besides that of bodies. So a rotor is a link of its own on the
joint's parent, with a tiny moment J, and turns n = √(D/J) times as fast as the joint moves: its
energy is ½ D q̇², that of the armature D. As it also turns with its carrier, it has a momentum of
√(D J) q̇ about its axis, which is the error of this model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from mbds_xsim.scene.mechanism import PlacedJoint

from .client import BARE_LINK, Client, Constant

# Bullet treats 2e-16 kg·m² as zero.
_MOMENT = 1e-15
IMPULSE_CAP = 1e12
"""Largest impulse of a constraint in a step [N·s]; Bullet's own cap is 500."""


def tie(client: Client, ends: Sequence[tuple[int, int]], ratio: float, **more: float) -> int:
    """Tie the rates of two links' joints, the first of which follows; return Bullet's number.

    The start satisfies the gear, and Bullet keeps it so.
    """
    zero = [0.0, 0.0, 0.0]
    number = client.build(
        "createConstraint", *ends[0], *ends[1], Constant("JOINT_GEAR"), zero, zero, zero
    )
    client.build("changeConstraint", number, gearRatio=-ratio, maxForce=IMPULSE_CAP, **more)
    return int(number)


def speed(joint: PlacedJoint) -> float:
    """Return the rate of a joint's rotor over that of the joint [1 or rad/m]."""
    return math.sqrt(joint.armature / _MOMENT)


def rotors(
    links: Sequence[Mapping[str, Any]], joints: Sequence[PlacedJoint]
) -> list[dict[str, Any]]:
    """Return rotors as `createMultiBody` takes them, given the same of links and their joints."""
    return [
        {
            **BARE_LINK,
            **{key: link[key] for key in ("linkParentIndices", "linkJointAxis")},
            "linkMasses": _MOMENT,
            "linkJointTypes": Constant("JOINT_REVOLUTE"),
        }
        for link, joint in zip(links, joints, strict=True)
        if joint.armature
    ]


def gear_rotors(client: Client, number: int, joints: Sequence[PlacedJoint]) -> None:
    """Let the joints of a multibody's links turn their rotors, which follow the links."""
    geared = [k for k, joint in enumerate(joints) if joint.armature]
    for rotor, k in enumerate(geared, len(joints)):
        client.note(f"rotor of {joints[k].name!r}")
        client.build("changeDynamics", number, rotor, localInertiaDiagonal=[_MOMENT] * 3)
        client.build(
            "setJointMotorControl2", number, rotor, Constant("VELOCITY_CONTROL"), force=0.0
        )
        # A rotor's angle means nothing, so its error is not corrected.
        tie(client, [(number, rotor), (number, k)], speed(joints[k]), erp=0.0)
