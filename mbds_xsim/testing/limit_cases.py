"""Cases of limits: joints that run into their stops, and servos that saturate."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Clock, Joint, Torque
from mbds_xsim.scene.servo import Servo
from mbds_xsim.testing.case import NONE, Case, G, case_of, even, integrate
from mbds_xsim.testing.joint_cases import CARRIER, UP, WHEEL, along, on_a_carrier, settling


def _stopped() -> Case:
    """A wheel on a free carrier turns until it meets its stop, and takes the carrier along.

    As in the case of the brake, the momentum is the wheel's at the start.
    """
    # A third into a step whether a frame has 4 or 16 steps, as errors depend on that share.
    rate, stop = 5.0, 5.0 * 277 / 600

    def turned(time: Array) -> Array:
        return WHEEL * (rate * time - np.minimum(rate * time, stop)) / (CARRIER + WHEEL)

    return on_a_carrier(
        "stopped wheel",
        "upper limit of a hinge, its reaction",
        turned,
        Joint("axle", "hinge", "carrier", "wheel", NONE, UP, rate=rate, limits=(-1.0, stop)),
    )


def _leaning() -> Case:
    """A rod falls onto its stop, rests there, and is later pulled away by a torque."""
    mass, arm, moment, stop, torque, hold = 1.2, 0.5, 0.05, -0.9, 9.0, 40
    about = moment + mass * arm**2
    clock = Clock(frame=0.02, steps=60)

    def exact(time: Array) -> Array:
        fallen = integrate(lambda a: -mass * G * arm * np.cos(a) / about, 0.0, 0.0, time)
        angle = np.maximum(fallen, stop)
        angle[np.argmax(angle == stop) :] = stop
        late = time >= hold * clock.frame - 1e-12
        angle[late] = integrate(
            lambda a: (torque - mass * G * arm * np.cos(a)) / about,
            stop, 0.0, time[late] - hold * clock.frame,
        )  # fmt: skip
        return arm * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=-1)[:, None]

    return case_of(
        "leaning rod",
        "lower limit of a hinge: it carries a weight, and lets go",
        [even("rod", mass, moment, (arm, 0.0, 0.0))],
        exact,
        Joint("pivot", "hinge", "world", "rod", NONE, (0.0, -1.0, 0.0), limits=(stop, 1.5)),
        torques=(Torque("pivot", (0.0, torque), hold),),
        clock=clock,
    )


def _bouncing() -> Case:
    """A block falls along a rail onto its stop, bounces at ever shorter intervals, and rests."""
    start, stop, restitution = 0.1, -0.3, 0.5

    def exact(time: Array) -> Array:
        fall = np.sqrt(2.0 * (start - stop) / G)
        begins, speed = [fall], [restitution * G * fall]
        while speed[-1] > 1e-12:
            begins.append(begins[-1] + 2.0 * speed[-1] / G)
            speed.append(restitution * speed[-1])
        hop = np.searchsorted(begins, time, side="right") - 1
        since = time - np.array(begins)[hop]
        bouncing = stop + np.maximum(np.array(speed)[hop] * since - 0.5 * G * since**2, 0.0)
        return along(UP, np.where(hop < 0, start - 0.5 * G * time**2, bouncing))

    return case_of(
        "bouncing block",
        "rebound of a slider from its limit, and where the bounces end",
        [even("block", 1.5, 0.1)],
        exact,
        Joint(
            "rail", "slider", "world", "block", NONE, UP, start=start, limits=(stop, 1.0),
            restitution=restitution,
        ),
    )  # fmt: skip


STOP_CASES: tuple[Case, ...] = (_stopped(), _leaning(), _bouncing())


_CART, _BLOCK = 2.0, 1.0
_APART = _CART * _BLOCK / (_CART + _BLOCK)
"""Reduced mass of the two [kg], for a force between them."""


def _opposed_servos(name: str, covers: str, armature: float = 0.0) -> Case:
    """Two saturated servos drive a wheel in opposite senses: the sum of their torques is constant.

    The momentum of the wheel and its free carrier stays 0; a rotor has no momentum of its own.
    """
    forth, back = 0.6, 0.2
    inertia = CARRIER * WHEEL / (CARRIER + WHEEL) + armature

    def turned(time: Array) -> Array:
        return -WHEEL / (CARRIER + WHEEL) * 0.5 * (forth - back) / inertia * time**2

    return on_a_carrier(
        name,
        covers,
        turned,
        Joint("axle", "hinge", "carrier", "wheel", NONE, UP, armature=armature),
        servos=(
            Servo("axle", velocity=(50.0,), damping=0.4, limit=forth),
            Servo("axle", velocity=(-50.0,), damping=0.4, limit=back),
        ),
    )


def _letting_go() -> Case:
    """A servo pushes a block along a free cart at its limit, until it needs less force.

    The target is such that spring and damper need less from a given time on, because of the
    distance covered by then. A later target, near the first one, is within the limit.
    """
    stiffness, damping, limit = 10.0, 4.0, 1.0
    leaves = 277 / 600  # a third into a step whether a frame has 4 or 16 steps
    way, speed = 0.5 * limit / _APART * leaves**2, limit / _APART * leaves
    target = way + (limit + damping * speed) / stiffness
    hold, other = 40, target + 0.05
    law = (stiffness, damping, _APART)

    def apart(time: Array) -> Array:
        changes = hold * Clock().frame
        until = np.array([changes - leaves])
        (off,) = settling(*law, way - target, speed, until)
        # The rate obeys the same equation.
        bend = -(stiffness * (way - target) + damping * speed) / _APART
        (rate,) = settling(*law, speed, bend, until)
        late, last = np.maximum(time - leaves, 0.0), np.maximum(time - changes, 0.0)
        settled = target + settling(*law, way - target, speed, late)
        again = other + settling(*law, target + off - other, float(rate), last)
        moved = np.where(time < changes, settled, again)
        return np.where(time < leaves, 0.5 * limit / _APART * time**2, moved)

    def exact(time: Array) -> Array:
        moved, none = apart(time), 0.0 * time
        cart = -_BLOCK / (_CART + _BLOCK) * moved
        return np.stack([np.stack([x, none, none], axis=-1) for x in (cart, cart + moved)], axis=1)

    along = (1.0, 0.0, 0.0)
    return case_of(
        "servo that lets go",
        "limit of a servo's force on a slider between two bodies, the time at which it wants less",
        [even("cart", _CART, 0.1), even("block", _BLOCK, 0.1)],
        exact,
        Joint("rail", "slider", "world", "cart", NONE, along, rate=0.0),
        Joint("deck", "slider", "block", "cart", NONE, (-1.0, 0.0, 0.0), rate=0.0),
        gravity=NONE,
        servos=(Servo("deck", (target, other), (0.0,), stiffness, damping, hold, limit),),
    )


SERVO_CASES: tuple[Case, ...] = (
    _opposed_servos(
        "saturated servo", "limits of servos' torques, several on one joint, their reaction"
    ),
    _opposed_servos("geared servo", "armature of a hinge that has servos with limits", 0.15),
    _letting_go(),
)
