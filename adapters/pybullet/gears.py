"""Gears: joints that follow others, and rotors, which a joint turns by a gear.

Bullet has no inertia of a joint beside those of its bodies. Here a rotor is a link of its own on
the joint's parent, of a moment J next to nothing, and turns n = √(D/J) times as fast as the joint
moves: its energy is ½ D q̇² of the armature D. As it turns with its carrier too, it also has a
momentum of √(D J) q̇ about its axis, which is what this is off by.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mbds_xsim.scene.mechanism import PlacedJoint

from .client import Client, Constant
from .parts import Multibody

# Bullet takes 2e-16 kg·m² for nothing.
_MOMENT = 1e-15
# Impulse of a constraint in a step [N·s]; Bullet's own cap is 500.
IMPULSE_CAP = 1e12


def tie(client: Client, ends: Sequence[tuple[int, int]], ratio: float, **more: float) -> None:
    """Tie the rates of two links' joints, the first of which follows.

    The start is on the gear, and Bullet keeps it there.
    """
    none = [0.0, 0.0, 0.0]
    number = client.build(
        "createConstraint", *ends[0], *ends[1], Constant("JOINT_GEAR"), none, none, none
    )
    client.build("changeConstraint", number, gearRatio=-ratio, maxForce=IMPULSE_CAP, **more)


def speed(joint: PlacedJoint) -> float:
    """Give the rate of a joint's rotor over that of the joint [1 or rad/m]."""
    return math.sqrt(joint.armature / _MOMENT)


def with_rotors(
    links: Mapping[str, list[Any]], joints: Sequence[PlacedJoint]
) -> dict[str, list[Any]]:
    """Add rotors behind links, as the arguments of `createMultiBody` have them.

    Args:
        links: The arguments, by name.
        joints: Of the links.
    """
    geared = [k for k, joint in enumerate(joints) if joint.armature]
    none, still = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    alike = {
        "linkMasses": _MOMENT,
        "linkCollisionShapeIndices": -1,
        "linkVisualShapeIndices": -1,
        "linkPositions": none,
        "linkOrientations": still,
        "linkInertialFramePositions": none,
        "linkInertialFrameOrientations": still,
        "linkJointTypes": Constant("JOINT_REVOLUTE"),
    }
    added = {key: [value] * len(geared) for key, value in alike.items()}
    for key in ("linkParentIndices", "linkJointAxis"):
        added[key] = [links[key][k] for k in geared]
    return {key: [*values, *added[key]] for key, values in links.items()}


def gear_rotors(client: Client, number: int, joints: Sequence[PlacedJoint]) -> None:
    """Let the joints of a multibody's links turn their rotors, which stand behind its links."""
    geared = [k for k, joint in enumerate(joints) if joint.armature]
    for rotor, k in enumerate(geared, len(joints)):
        client.note(f"rotor of {joints[k].name!r}")
        client.build("changeDynamics", number, rotor, localInertiaDiagonal=[_MOMENT] * 3)
        client.build(
            "setJointMotorControl2", number, rotor, Constant("VELOCITY_CONTROL"), force=0.0
        )
        # By how much it has turned means nothing.
        tie(client, [(number, rotor), (number, k)], speed(joints[k]), erp=0.0)


def armatures(client: Client, parts: Iterable[tuple[int, Multibody]]) -> dict[int, float]:
    """Give those of multibodies' joints by the moments of their rotors, by index of the joint."""
    info = client.function("getDynamicsInfo")
    return {
        joint.index: speed(joint) ** 2 * info(number, rotor)[2][2]
        for number, part in parts
        for rotor, (joint, _) in enumerate(part.geared, len(part.links))
    }
