"""Cases of servos that saturate, and of one that leads a slider between two bodies."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Joint
from mbds_xsim.scene.servo import Servo
from mbds_xsim.testing.case import NONE, Case, Exact, case_of, even
from mbds_xsim.testing.joint_cases import CARRIER, LEADS, UP, WHEEL, led, on_a_carrier, settling

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


def _on_a_cart(name: str, verifies: str, apart: Exact, deck: Joint, servo: Servo) -> Case:
    """Make a case of a block on a cart that a servo moves along it; both are free along x.

    Args:
        name: Of the case.
        verifies: What it is for.
        apart: Times [s] to how far the block has moved on the cart [m].
        deck: Joins the two.
        servo: On it.
    """

    def exact(time: Array) -> Array:
        moved, none = apart(time), 0.0 * time
        cart = -_BLOCK / (_CART + _BLOCK) * moved
        return np.stack([np.stack([x, none, none], axis=-1) for x in (cart, cart + moved)], axis=1)

    along = (1.0, 0.0, 0.0)
    rail = Joint("rail", "slider", "world", "cart", NONE, along, rate=0.0)
    bodies = [even("cart", _CART, 0.1), even("block", _BLOCK, 0.1)]
    more: dict[str, Any] = {"gravity": NONE, "servos": (servo,)}
    return case_of(name, verifies, bodies, exact, rail, deck, **more)


def _letting_go() -> Case:
    """A servo pushes a block as hard as it can until its spring and damper want less.

    Where they come to want less at a given time follows from how far the block has got by then.
    """
    stiffness, damping, limit = 10.0, 4.0, 1.0
    leaves = 277 / 600  # a third of a step late whether a frame has 4 or 16 steps
    way, speed = 0.5 * limit / _APART * leaves**2, limit / _APART * leaves
    target = way + (limit + damping * speed) / stiffness

    def apart(time: Array) -> Array:
        late = np.maximum(time - leaves, 0.0)
        settled = target + settling(stiffness, damping, _APART, way - target, speed, late)
        return np.where(time < leaves, 0.5 * limit / _APART * time**2, settled)

    return _on_a_cart(
        "servo that lets go",
        "limit of a servo's force, the time at which it wants less",
        apart,
        Joint("deck", "slider", "block", "cart", NONE, (-1.0, 0.0, 0.0), rate=0.0),
        Servo("deck", (target,), stiffness=stiffness, damping=damping, limit=limit),
    )


def _led_on_a_cart() -> Case:
    """A servo without a limit leads the block to two targets, one after the other."""
    deck = Joint("deck", "slider", "cart", "block", NONE, (1.0, 0.0, 0.0), rate=0.0)
    servo = Servo("deck", (0.3, -0.2), **LEADS)  # type: ignore[arg-type]
    return _on_a_cart(
        "led block on a cart",
        "servo of a slider between two bodies with held targets",
        lambda time: led(_APART, deck, servo, time),
        deck,
        servo,
    )


SERVO_CASES: tuple[Case, ...] = (_saturated(), _letting_go(), _led_on_a_cart())
