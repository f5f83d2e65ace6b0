"""Cases of servos that saturate, on a hinge and on a slider between two bodies."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Clock, Joint
from mbds_xsim.scene.servo import Servo
from mbds_xsim.testing.case import NONE, Case, case_of, even
from mbds_xsim.testing.joint_cases import CARRIER, UP, WHEEL, on_a_carrier, settling

_CART, _BLOCK = 2.0, 1.0
_APART = _CART * _BLOCK / (_CART + _BLOCK)
"""What a force between the two moves."""


def _saturated() -> Case:
    """A servo wants a wheel far faster than its torque can make it: that torque is constant.

    The momentum of the wheel and its free carrier stays 0.
    """
    limit = 0.4
    inertia = CARRIER * WHEEL / (CARRIER + WHEEL)

    def turned(time: Array) -> Array:
        return -WHEEL / (CARRIER + WHEEL) * 0.5 * limit / inertia * time**2

    return on_a_carrier(
        "saturated servo",
        "limit of a servo's torque, its reaction",
        turned,
        Joint("axle", "hinge", "carrier", "wheel", NONE, UP),
        servos=(Servo("axle", velocity=(50.0,), damping=0.4, limit=limit),),
    )


def _letting_go() -> Case:
    """A servo pushes a block along a free cart as hard as it can, until it wants less.

    Where its spring and damper come to want less at a given time follows from how far the block has
    got by then. Later another target, near the first one, is within what it can do.
    """
    stiffness, damping, limit = 10.0, 4.0, 1.0
    leaves = 277 / 600  # a third of a step late whether a frame has 4 or 16 steps
    way, speed = 0.5 * limit / _APART * leaves**2, limit / _APART * leaves
    target = way + (limit + damping * speed) / stiffness
    hold, other = 40, target + 0.05
    law = (stiffness, damping, _APART)

    def apart(time: Array) -> Array:
        changes = hold * Clock().frame
        until = np.array([changes - leaves])
        (off,) = settling(*law, way - target, speed, until)
        # The rate changes by the same equation.
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


SERVO_CASES: tuple[Case, ...] = (_saturated(), _letting_go())
