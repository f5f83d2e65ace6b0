"""The vocabulary of sampling: how starts and inputs are drawn, as data in the scene.

`mbds_xsim.scene.sampling` carries these out. A `Span` is a range [low, high] from which a value is
drawn uniformly; it may depend on the trajectory's interval (low, medium, high).
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError

Interval = Literal["low", "medium", "high"]
INTERVALS: tuple[Interval, ...] = ("low", "medium", "high")
Vector = tuple[float, float, float]
Names = Annotated[tuple[str, ...], bounds.names]


def _ordered(key: str, span: tuple[float, float] | Levels) -> None:
    """Raise unless a range is finite and ordered; `Levels` has checked its own."""
    if isinstance(span, Levels):
        return
    if not (math.isfinite(span[1] - span[0]) and span[0] <= span[1]):
        msg = f"{key}: got {list(span)}, allowed is [low, high] of finite numbers, low ≤ high"
        raise SceneError(msg)
    bounds.finite(key, span)


Range = Annotated[tuple[float, float], _ordered]


class Levels(Neutral):
    """One range per interval."""

    low: Range
    medium: Range
    high: Range


Span = Annotated[tuple[float, float] | Levels, _ordered]


def span_of(span: Span, interval: Interval) -> Range:
    """Return the range that applies in an interval."""
    return getattr(span, interval) if isinstance(span, Levels) else span


class Swing(Neutral, tag_field="kind", tag="swing"):
    """Hang a chain of ball-jointed bodies in random directions.

    For each body, in the given order, drawn in this order: polar angle of the arm (from the
    body's tree joint to its centre of mass) from −z, azimuth uniform in [0, 2π), speed of the
    centre of mass relative to the joint, and the direction of that speed uniform in the plane
    normal to the arm. The body has no spin about its arm; the arm hangs along −z at the
    reference pose.
    """

    bodies: Names
    polar: Span
    """Polar angle of the arm from −z [rad]."""
    speed: Span
    """Speed of the centre of mass relative to the joint [m/s]."""


class Turn(Neutral, tag_field="kind", tag="turn"):
    """Turn the whole scene rigidly about an axis, with a rigid rate (drawn: angle, rate)."""

    point: Annotated[Vector, bounds.place]
    """A point of the axis in W [m]."""
    axis: Annotated[Vector, bounds.direction]
    """Direction of the axis in W; need not be a unit vector."""
    angle: Span
    """Angle of the turn [rad]."""
    rate: Span
    """Rate about the axis [rad/s]."""


class Throw(Neutral, tag_field="kind", tag="throw"):
    """Throw one free body, with all bodies jointed to it, rigidly.

    Drawn in this order: displacement of its centre of mass from the reference pose (x, y, z),
    orientation, velocity (x, y, z), angular velocity (x, y, z). The rotation is about the
    body's centre of mass.
    """

    body: str
    displacement: tuple[Span, Span, Span] = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    """Displacement in W [m]."""
    orientation: Literal["reference", "about_y", "uniform"] = "reference"
    """Reference orientation kept, turned about y by a uniform angle, or uniform on SO(3)."""
    velocity: tuple[Span, Span, Span] = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    """Velocity in W [m/s]."""
    angular_velocity: tuple[Span, Span, Span] = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    """Angular velocity in W [rad/s]."""


class Roll(Neutral, tag_field="kind", tag="roll"):
    """Spin a free body at a share of the rate at which it would roll at its velocity.

    The share is drawn: 0 slides without spin, 1 rolls without slip. The body carries one contact
    sphere, at its centre of mass; all bodies jointed to it turn with it.
    """

    body: str
    share: Span


class Lift(Neutral, tag_field="kind", tag="lift"):
    """Raise or lower a body and those it carries until its lowest contact sphere is at a height.

    The body is free and moves with all bodies jointed to it, or an upright slider carries it.
    """

    body: str
    height: Span
    """Height of the sphere's lowest point above the ground [m]."""


class Pose(Neutral, tag_field="kind", tag="pose"):
    """Add a coordinate, drawn for each joint separately, to the one that the file gives.

    Joints that follow it by couplings move along.
    """

    joints: Names
    coordinate: Span
    """Coordinate of a hinge [rad] or slider [m]."""


class HingeRate(Neutral, tag_field="kind", tag="hinge_rate"):
    """Add a rate, drawn for each hinge separately, relative to the body that carries it.

    Joints that follow it by couplings move along.
    """

    joints: Names
    rate: Span
    """Rate to add [rad/s]."""
    travel: Annotated[Vector, bounds.finite] = (0.0, 0.0, 0.0)
    """Velocity in W per mean drawn rate, of the free bodies that carry the hinges and all bodies
    jointed to them [m/rad]: makes a car roll along on its wheels."""


class HingeTorque(Neutral, tag_field="kind", tag="hinge_torque"):
    """Drive hinges with piecewise constant torques.

    Drawn stretch by stretch, and within a stretch joint by joint: the value, then, with
    `random_sign`, its sign.
    """

    joints: Names
    torque: Span
    """Torque about each hinge [N·m]."""
    hold: Annotated[int, bounds.at_least_one] = 10
    """Number of frames that a stretch lasts."""
    random_sign: bool = False


class Wind(Neutral, tag_field="kind", tag="wind"):
    """Blow horizontally on every particle with the same force A(t)·(cos φ, sin φ, 0).

    A(t) is an Ornstein–Uhlenbeck process started from its stationary distribution. Drawn in this
    order: φ uniform in [0, 2π), the mean of A from `mean`, then one standard normal per frame.
    """

    mean: Span
    """Mean force on a particle [N]."""
    deviation: Annotated[float, bounds.at_least_zero] = 0.3
    """Standard deviation of A relative to its mean."""
    correlation_time: Annotated[float, bounds.positive] = 0.5
    """Correlation time of A [s]."""


Draw = Swing | Turn | Throw | Roll | Lift | Pose | HingeRate | HingeTorque | Wind
