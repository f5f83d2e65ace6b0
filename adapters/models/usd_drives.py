"""Drives of USD joints: motors that lead them to the targets of the file."""

from __future__ import annotations

import math
from typing import Any

from .parts import Drive

_UNLIMITED = 3e38  # single precision has no larger number


def drive_of(
    drive: Any, joint: str, kind: str, start: float, units: tuple[float, float]
) -> Drive | str:
    """Give a drive in SI units, or say why it is no servo.

    Args:
        drive: As the library of OpenUSD parses it.
        joint: The freedom that it leads.
        kind: Of the freedom, hinge or slider.
        start: Its coordinate in the file where the bodies stand [rad or m].
        units: Of lengths [m] and masses [kg].
    """
    if drive.acceleration:
        return "its gains are of accelerations, and those of servos are of torques and forces"
    if drive.stiffness < 0 or drive.damping < 0 or not (drive.stiffness or drive.damping):
        return "it has a negative gain, or none"
    metre, kilogram = units
    turns = kind == "hinge"
    unit = math.pi / 180 if turns else metre
    force = kilogram * metre * (metre if turns else 1.0)
    limit = force * drive.forceLimit if drive.forceLimit < _UNLIMITED else None
    return Drive(
        name=joint,
        joint=joint,
        stiffness=drive.stiffness * force / unit,
        damping=drive.damping * force / unit,
        position=drive.targetPosition * unit - start if drive.stiffness else 0.0,
        velocity=drive.targetVelocity * unit,
        limit=limit or None,
        unkept="" if limit != 0.0 else "it is 0",
        led="to the target of the file",
    )
