"""A motor that leads a hinge to held targets."""

from __future__ import annotations

from typing import Annotated

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError


class Servo(Neutral):
    """A proportional and derivative controller on a hinge, the same in every trajectory.

    It is a spring and damper between the hinge and its targets: a position servo has a stiffness, a
    velocity servo a damping alone.
    """

    joint: str
    position: Annotated[tuple[float, ...], bounds.rows] = (0.0,)
    """Angles to go to [rad], one per held stretch."""
    velocity: Annotated[tuple[float, ...], bounds.rows] = (0.0,)
    """Rates to go at [rad/s], likewise."""
    stiffness: Annotated[float, bounds.at_least_zero] = 0.0
    """Torque per angle off the target [N·m/rad]."""
    damping: Annotated[float, bounds.at_least_zero] = 0.0
    """Torque per rate off the target [N·m·s/rad]."""
    hold: Annotated[int, bounds.at_least_one] = 1
    """Frames that each target lasts; the last goes on to the end."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.stiffness or self.damping):
            msg = f"servo of {self.joint!r}: got neither stiffness nor damping, allowed is either"
            raise SceneError(msg)


def gains(servos: tuple[Servo, ...], joint: str) -> tuple[float, float]:
    """Sum up the stiffness and the damping of a joint's servos; what leads them is an input."""
    mine = [servo for servo in servos if servo.joint == joint]
    return sum(servo.stiffness for servo in mine), sum(servo.damping for servo in mine)
