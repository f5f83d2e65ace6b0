"""A motor that leads a hinge or slider to held targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from mbds_xsim.base import bounds
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError

if TYPE_CHECKING:
    from mbds_xsim.scene.mechanism import PlacedJoint
    from mbds_xsim.scene.scene import Joint

_WORLD = "world"


class Servo(Neutral):
    """A proportional and derivative controller on a joint, the same in every trajectory.

    It is a spring and damper between the joint and its targets: a position servo has a stiffness, a
    velocity servo a damping alone. With a limit it saturates there.
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
    limit: Annotated[float, bounds.positive] | None = None
    """Largest torque [N·m] or force [N] that it gives, either way; left out, any."""

    added = ("limit",)

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

    def is_drive(self, joint: Joint) -> bool:
        """Whether no spring, damper and held input of its joint come to the same.

        A torque about a hinge can be held, and so can a force along a slider on the world.
        """
        moving = joint.kind == "slider" and _WORLD not in (joint.parent, joint.child)
        return self.limit is not None or (moving and self.needs_input)

    def push(self, rest: float) -> tuple[Array, Array]:
        """Give torques or forces of its targets on a joint that is slack at a coordinate."""
        lead = self.stiffness * (np.array(self.position) - rest)
        return lead, self.damping * np.array(self.velocity)


def law_of(joint: Joint, servos: tuple[Servo, ...]) -> tuple[float, float, float]:
    """Sum up stiffness, damping and rest of a joint's own spring and damper and of its servos.

    What leads the servos of a hinge is an input, and of a slider if it changes; else it shifts the
    rest. Drives are not among them.
    """
    mine = [servo for servo in servos if servo.joint == joint.name and not servo.is_drive(joint)]
    stiffness = joint.stiffness + sum(servo.stiffness for servo in mine)
    damping = joint.damping + sum(servo.damping for servo in mine)
    if joint.kind == "hinge" or not (mine and stiffness) or any(s.needs_input for s in mine):
        return stiffness, damping, joint.rest
    pulls = (s.stiffness * s.position[0] + s.damping * s.velocity[0] for s in mine)
    return stiffness, damping, (joint.stiffness * joint.rest + sum(pulls)) / stiffness


@dataclass(frozen=True, eq=False)
class PlacedDrive:
    """A servo that acts on the coordinate of a joint of the tree, by the state at every instant."""

    joint: PlacedJoint
    servo: Servo

    @property
    def limit(self) -> float:
        """Of its torque or force, infinite without one."""
        return np.inf if self.servo.limit is None else self.servo.limit

    def effort(self, push: Array | float, coordinate: Array | float, rate: Array | float) -> Array:
        """Give the torque [N·m] or force [N] along the axis on the child.

        Args:
            push: What its targets exert where joint and rate are 0, as `pushes` has it.
            coordinate: Of the joint [rad or m], with whole turns.
            rate: [rad/s or m/s].
        """
        return np.clip(self.wanted(push, coordinate, rate), -self.limit, self.limit)

    def at(self, push: float, coordinate: float, rate: float) -> float:
        """Give the same of numbers, which is called in every step of some engines."""
        servo = self.servo
        wanted = push - servo.stiffness * coordinate - servo.damping * rate
        return wanted if servo.limit is None else min(max(wanted, -servo.limit), servo.limit)

    def wanted(self, push: Array | float, coordinate: Array | float, rate: Array | float) -> Array:
        """Give what it would exert without a limit."""
        spring = self.servo.stiffness * np.asarray(coordinate)
        return np.asarray(push - spring - self.servo.damping * np.asarray(rate))

    def as_read(self) -> tuple[float, float, float]:
        """Give stiffness, damping and limit, as `Readback.drive` has it."""
        return self.servo.stiffness, self.servo.damping, self.servo.limit or 0.0

    def formula(self) -> str:
        """Write `effort` at its first target in Python, of variables `angle` and `rate`."""
        push, servo = float(self.pushes(1)[0]), self.servo
        wanted = f"{push!r} - {servo.stiffness!r} * angle - {servo.damping!r} * rate"
        if servo.limit is None:
            return wanted
        return f"min(max({wanted}, -{servo.limit!r}), {servo.limit!r})"

    def pushes(self, steps: int) -> Array:
        """Give what its targets exert where joint and rate are 0, shape (step,)."""
        first, second = (held(part, self.servo.hold, steps) for part in self.servo.push(0.0))
        return first + second


def with_pushes(drives: tuple[PlacedDrive, ...], torque: Array) -> Array:
    """Put what the targets of drives exert behind the torques of hinges.

    Args:
        drives: Those of a mechanism.
        torque: From the first step on, shape (…, step, hinge).

    Returns:
        Shape (…, step, hinge + drive).
    """
    if not drives:
        return torque
    pushes = np.stack([drive.pushes(torque.shape[-2]) for drive in drives], axis=-1)
    pushes = np.broadcast_to(pushes, (*torque.shape[:-1], len(drives)))
    return np.concatenate([torque, pushes], axis=-1)


def held(series: Array, hold: int, steps: int) -> Array:
    """Let each row of a series last for some frames, and the last one to the end, (step, …)."""
    rows = np.minimum(np.arange(steps) // hold, len(series) - 1)
    return np.asarray(series[rows])
