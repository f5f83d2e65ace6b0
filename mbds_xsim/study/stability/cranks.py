"""Cranks of equal length on one rod, which all turn alike."""

from __future__ import annotations

import math

from mbds_xsim.scene import Body, Inertia, Joint, Scene

__all__ = ["cranks"]

_CRANK = 1.0  # length [m]
_APART = 1.0  # between cranks [m]
_SLIM = 1e-3  # of a rod's inertia about its own line
_AXIS = (0.0, -1.0, 0.0)


def cranks(count: int, angle: float, rate: float) -> Scene:
    """Make the linkage of uniform rods of 1 kg per metre, in the x–z plane.

    Args:
        count: Cranks, 2 or more.
        angle: Of the cranks above the horizontal [rad].
        rate: At which it grows [rad/s].
    """
    reach = (_CRANK * math.cos(angle), 0.0, _CRANK * math.sin(angle))
    speed = (-rate * reach[2], 0.0, rate * reach[0])
    turn = (math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0)
    width = (count - 1) * _APART
    bodies = [
        Body(
            f"crank{k}",
            inertia=_rod(_CRANK),
            position=(_APART * k + 0.5 * reach[0], 0.0, 0.5 * reach[2]),
            orientation=turn,
            velocity=(0.5 * speed[0], 0.0, 0.5 * speed[2]),
            angular_velocity=(0.0, -rate, 0.0),
        )
        for k in range(count)
    ]
    coupler = Body(
        "coupler",
        inertia=_rod(width),
        position=(reach[0] + 0.5 * width, 0.0, reach[2]),
        velocity=speed,
        angular_velocity=(0.0, 0.0, 0.0),
    )
    joints = [
        joint
        for k in range(count)
        for joint in (
            Joint(f"foot{k}", "hinge", "world", f"crank{k}", (_APART * k, 0.0, 0.0), _AXIS),
            Joint(
                f"pin{k}", "hinge", f"crank{k}", "coupler",
                (_APART * k + reach[0], 0.0, reach[2]), _AXIS,
            ),
        )
    ]  # fmt: skip
    return Scene(
        name="cranks", bodies=(*bodies, coupler), joints=tuple(joints), length=_CRANK, dimension=2
    )


def _rod(length: float) -> Inertia:
    moment = length**3 / 12.0
    return Inertia(mass=length, moments=(_SLIM * moment, moment, moment))
