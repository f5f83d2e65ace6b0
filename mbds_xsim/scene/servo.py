"""A motor that leads a hinge or slider to held targets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from mbds_xsim.base import bounds
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
    """Angles to go to [rad], one per held stretch, or the one place of a slider [m]."""
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

    def check_one_target(self, where: str) -> None:
        """Raise SceneError unless it is a spring and damper, as of a slider: no input drives it."""
        if len({*self.position}) > 1 or len({*self.velocity}) > 1:
            raise SceneError(f"{where}: got several targets, allowed on a slider is one")
        if any(self.velocity) and not self.stiffness:
            raise SceneError(f"{where}.stiffness: got 0 with a rate, allowed on a slider is more")


def law_of(joint: Joint, servos: tuple[Servo, ...]) -> tuple[float, float, float]:
    """Sum up stiffness, damping and rest of a joint's own spring and damper and of its servos.

    What leads the servos of a hinge is an input; a slider's have one target, which shifts the rest.
    """
    mine = [servo for servo in servos if servo.joint == joint.name]
    stiffness = joint.stiffness + sum(servo.stiffness for servo in mine)
    damping = joint.damping + sum(servo.damping for servo in mine)
    if joint.kind == "hinge" or not (mine and stiffness):
        return stiffness, damping, joint.rest
    pulls = (s.stiffness * s.position[0] + s.damping * s.velocity[0] for s in mine)
    return stiffness, damping, (joint.stiffness * joint.rest + sum(pulls)) / stiffness
