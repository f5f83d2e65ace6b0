"""A motor that drives a hinge or slider towards held targets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
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
    """A proportional–derivative controller on a joint, the same in every trajectory.

    It is a spring and damper between the joint and its targets: a position servo has a stiffness, a
    velocity servo only a damping. A limit saturates its output.
    """

    joint: str
    position: Annotated[tuple[float, ...], bounds.rows] = (0.0,)
    """Target angles [rad] or positions [m], one per stretch of `hold` frames."""
    velocity: Annotated[tuple[float, ...], bounds.rows] = (0.0,)
    """Target rates [rad/s] or [m/s], one per stretch of `hold` frames."""
    stiffness: Annotated[float, bounds.at_least_zero] = 0.0
    """Torque per angle from the target [N·m/rad] or force per distance [N/m]."""
    damping: Annotated[float, bounds.at_least_zero] = 0.0
    """Torque per rate from the target [N·m·s/rad] or force per speed [N·s/m]."""
    hold: Annotated[int, bounds.at_least_one] = 1
    """Number of frames that each target lasts; the last target continues to the end."""
    limit: Annotated[float, bounds.positive] | None = None
    """Largest torque [N·m] or force [N] in either direction; unlimited if omitted."""

    added = ("limit",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.stiffness or self.damping):
            msg = f"servo of {self.joint!r}: got neither stiffness nor damping, needs one or both"
            raise SceneError(msg)

    @property
    def needs_input(self) -> bool:
        """Whether it needs an input in addition to a spring and damper."""
        changes = len({*self.position}) > 1 or len({*self.velocity}) > 1
        return changes or (any(self.velocity) and not self.stiffness)

    def is_drive(self, joint: Joint) -> bool:
        """Return whether no spring, damper and held input on its joint can replace it.

        A torque about a hinge can be held, and so can a force along a slider on the world.
        """
        moving = joint.kind == "slider" and _WORLD not in (joint.parent, joint.child)
        return self.limit is not None or (moving and self.needs_input)

    def push(self, rest: float) -> tuple[Array, Array]:
        """Return the efforts [N·m or N] of position targets, relative to `rest`, and of rates."""
        lead = self.stiffness * (np.array(self.position) - rest)
        return lead, self.damping * np.array(self.velocity)


def by_joint(servos: Iterable[Servo]) -> defaultdict[str, list[Servo]]:
    """Group servos by the joint that they drive."""
    groups: defaultdict[str, list[Servo]] = defaultdict(list)
    for servo in servos:
        groups[servo.joint].append(servo)
    return groups


def law_of(joint: Joint, servos: Iterable[Servo]) -> tuple[float, float, float]:
    """Combine a joint's own spring and damper with its servos into stiffness, damping and rest.

    Targets of a hinge's servos act as inputs, those of a slider's only if they change; otherwise
    they shift the rest coordinate. Drives are left out.
    """
    mine = [servo for servo in servos if not servo.is_drive(joint)]
    stiffness = joint.stiffness + sum(servo.stiffness for servo in mine)
    damping = joint.damping + sum(servo.damping for servo in mine)
    if joint.kind == "hinge" or not (mine and stiffness) or any(s.needs_input for s in mine):
        return stiffness, damping, joint.rest
    pulls = (s.stiffness * s.position[0] + s.damping * s.velocity[0] for s in mine)
    return stiffness, damping, (joint.stiffness * joint.rest + sum(pulls)) / stiffness


@dataclass(frozen=True, eq=False)
class PlacedDrive:
    """A servo on a joint of the tree whose effort depends on the state at every instant."""

    joint: PlacedJoint
    servo: Servo

    @property
    def limit(self) -> float:
        """Limit of its torque or force; infinite without one."""
        return np.inf if self.servo.limit is None else self.servo.limit

    def effort(self, push: Array | float, coordinate: Array | float, rate: Array | float) -> Array:
        """Return the torque [N·m] or force [N] along the axis on the child.

        Args:
            push: Effort of its targets where coordinate and rate are 0, as from `pushes`.
            coordinate: Coordinate of the joint [rad or m], with whole turns.
            rate: Rate of the joint [rad/s or m/s].
        """
        return np.clip(self.demand(push, coordinate, rate), -self.limit, self.limit)

    def at(self, push: float, coordinate: float, rate: float) -> float:
        """Return `effort` for plain numbers, which some engines need in every step."""
        servo = self.servo
        wanted = push - servo.stiffness * coordinate - servo.damping * rate
        return wanted if servo.limit is None else min(max(wanted, -servo.limit), servo.limit)

    def demand(self, push: Array | float, coordinate: Array | float, rate: Array | float) -> Array:
        """Return the effort without the limit."""
        spring = self.servo.stiffness * np.asarray(coordinate)
        return np.asarray(push - spring - self.servo.damping * np.asarray(rate))

    def as_read(self) -> tuple[float, float, float]:
        """Return stiffness, damping and limit (0: none), as in `Readback.drive`."""
        return self.servo.stiffness, self.servo.damping, self.servo.limit or 0.0

    def formula(self) -> str:
        """Write `effort` at the first target in Python, with variables `angle` and `rate`."""
        push, servo = float(self.pushes(1)[0]), self.servo
        wanted = f"{push!r} - {servo.stiffness!r} * angle - {servo.damping!r} * rate"
        if servo.limit is None:
            return wanted
        return f"min(max({wanted}, -{servo.limit!r}), {servo.limit!r})"

    def pushes(self, steps: int) -> Array:
        """Return the effort of its targets where coordinate and rate are 0, shape (step,)."""
        first, second = (
            zero_order_hold(part, self.servo.hold, steps) for part in self.servo.push(0.0)
        )
        return first + second


def with_pushes(drives: tuple[PlacedDrive, ...], torque: Array) -> Array:
    """Append the pushes of drives to the torques of hinges.

    Args:
        drives: Drives of the mechanism.
        torque: Torques from the first step on, shape (…, step, hinge).

    Returns:
        Torques and pushes, shape (…, step, hinge + drive).
    """
    if not drives:
        return torque
    pushes = np.stack([drive.pushes(torque.shape[-2]) for drive in drives], axis=-1)
    pushes = np.broadcast_to(pushes, (*torque.shape[:-1], len(drives)))
    return np.concatenate([torque, pushes], axis=-1)


def zero_order_hold(series: Array, hold: int, steps: int) -> Array:
    """Repeat each row of a series for `hold` steps, and the last to the end; shape (step, …)."""
    rows = np.minimum(np.arange(steps) // hold, len(series) - 1)
    return np.asarray(series[rows])
