"""A motor that leads a hinge or slider to held targets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np

from mbds_xsim.base import bounds
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError

if TYPE_CHECKING:
    from mbds_xsim.scene.scene import Joint


class Servo(Neutral):
    """A proportional and derivative controller on a joint, the same in every trajectory.

    It is a spring and damper between the joint and its targets: a position servo has a stiffness, a
    velocity servo a damping alone.
    """

    joint: str
    position: Annotated[tuple[float, ...], bounds.rows] = (0.0,)
    """Angles [rad] or places [m] to go to, one per held stretch."""
    velocity: Annotated[tuple[float, ...], bounds.rows] = (0.0,)
    """Rates to go at [rad/s] or [m/s], likewise."""
    stiffness: Annotated[float, bounds.at_least_zero] = 0.0
    """Torque per angle off the target [N·m/rad] or force per way [N/m]."""
    damping: Annotated[float, bounds.at_least_zero] = 0.0
    """Torque per rate off the target [N·m·s/rad] or force per speed [N·s/m]."""
    hold: Annotated[int, bounds.at_least_one] = 1
    """Frames that each target lasts; the last goes on to the end."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.stiffness or self.damping):
            msg = f"servo of {self.joint!r}: got neither stiffness nor damping, allowed is either"
            raise SceneError(msg)

    @property
    def needs_input(self) -> bool:
        """Whether it is more than a spring and damper."""
        changes = len({*self.position}) > 1 or len({*self.velocity}) > 1
        return changes or (any(self.velocity) and not self.stiffness)

    def check_one_target(self, where: str) -> None:
        """Raise SceneError unless it is a spring and damper: no input drives its joint."""
        if self.needs_input:
            what = "several targets" if len({*self.position, *self.velocity}) > 2 else "a speed"
            msg = f"{where}: got {what}, allowed on a slider between two bodies is one place"
            raise SceneError(msg)

    def push(self, rest: float) -> tuple[Array, Array]:
        """Give torques or forces of its targets on a joint that is slack at a coordinate."""
        lead = self.stiffness * (np.array(self.position) - rest)
        return lead, self.damping * np.array(self.velocity)


def law_of(joint: Joint, servos: tuple[Servo, ...]) -> tuple[float, float, float]:
    """Sum up stiffness, damping and rest of a joint's own spring and damper and of its servos.

    What leads the servos of a hinge is an input, and of a slider if it changes; else it shifts the
    rest.
    """
    mine = [servo for servo in servos if servo.joint == joint.name]
    stiffness = joint.stiffness + sum(servo.stiffness for servo in mine)
    damping = joint.damping + sum(servo.damping for servo in mine)
    if joint.kind == "hinge" or not (mine and stiffness) or any(s.needs_input for s in mine):
        return stiffness, damping, joint.rest
    pulls = (s.stiffness * s.position[0] + s.damping * s.velocity[0] for s in mine)
    return stiffness, damping, (joint.stiffness * joint.rest + sum(pulls)) / stiffness
