"""Drives of USD joints: motors that move them to the targets in the file."""

from __future__ import annotations

import math
from typing import Any

from .parts import Drive

_UNLIMITED = 3e38  # single precision has no larger number


def drive_of(
    drive: Any, joint: str, kind: str, start: float, units: tuple[float, float]
) -> Drive | str:
    """Return a drive in SI units, or the reason why it cannot be a servo.

    Args:
        drive: Drive as the library of OpenUSD parses it.
        joint: Name of the freedom that it drives.
        kind: Kind of the freedom, hinge or slider.
        start: Coordinate in the file at the reference pose [rad or m].
        units: Units of lengths [m] and masses [kg].
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
        limit_loss="" if limit != 0.0 else "it is 0",
        target="to the target of the file",
    )
