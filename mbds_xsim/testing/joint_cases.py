"""Cases of springs, dampers, rotors, servos and couplings of joints."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.scene import Clock, Joint, Torque, Vector
from mbds_xsim.scene.servo import Servo
from mbds_xsim.testing.case import NONE, Case, Exact, G, case_of, direction, even, solve

UP: Vector = (0.0, 0.0, 1.0)
WHEEL, _ARM = 0.1, 0.5
CARRIER = 0.4 + 0.01 + 0.5 * _ARM**2
"""Moments of inertia about the mount of `on_a_carrier`; the tip is in the carrier's [kg·m²]."""
_REDUCED = CARRIER * WHEEL / (CARRIER + WHEEL)


def around(angle: Array) -> Array:
    """Return the directions at angles [rad] from x towards y, shape (…, 3)."""
    return np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)


def along(axis: Vector, way: Array) -> Array:
    """Return the places of one body at distances [m] along an axis, shape (frame, 1, 3)."""
    return way[:, None, None] * np.array(axis)


def settling(
    stiffness: float, damping: float, inertia: float, start: float, rate: float, time: Array
) -> Array:
    """Solve I x'' = −k x − d x' for an underdamped oscillation."""
    decay = damping / (2.0 * inertia)
    omega = np.sqrt(stiffness / inertia - decay**2)
    swing = start * np.cos(omega * time) + (rate + decay * start) / omega * np.sin(omega * time)
    return np.asarray(np.exp(-decay * time) * swing)


def on_a_carrier(name: str, verifies: str, turned: Exact, axle: Joint, **more: Any) -> Case:
    """Make a case of a wheel on a carrier that turns about a mount; a tip on an arm shows it.

    Args:
        name: Name of the case.
        verifies: Features that the case is for.
        turned: Function from times [s] to the carrier's angles of rotation [rad].
        axle: Joint between the carrier and the wheel.
        more: Other fields of the scene.
    """

    def exact(time: Array) -> Array:
        tip = _ARM * around(turned(time))
        return np.stack([0.0 * tip, 0.0 * tip, tip], axis=1)

    return case_of(
        name,
        verifies,
        [
            even("carrier", 2.0, 0.4),
            even("wheel", 1.0, WHEEL),
            even("tip", 0.5, 0.01, (_ARM, 0.0, 0.0)),
        ],
        exact,
        Joint("mount", "hinge", "world", "carrier", NONE, UP, rate=0.0),
        axle,
        Joint("weld", "fixed", "carrier", "tip", (_ARM, 0.0, 0.0)),
        gravity=NONE,
        **more,
    )


def _sprung_hinge() -> Case:
    """A wheel winds up a spring against its free carrier, by more than half a turn.

    The axle's parent is the wheel.
    """
    stiffness, damping, rest, rate = 3.0, 0.05, 0.7, 20.0

    def turned(time: Array) -> Array:
        angle = rest + settling(stiffness, damping, _REDUCED, -rest, rate, time)
        # The only momentum is the wheel's at the start.
        return WHEEL * (rate * time - angle) / (CARRIER + WHEEL)

    return on_a_carrier(
        "sprung hinge",
        "spring and damper of a hinge, their sign and reaction, whole turns",
        turned,
        Joint(
            "axle", "hinge", "wheel", "carrier", NONE, (0.0, 0.0, -1.0), rate=rate,
            stiffness=stiffness, damping=damping, rest=rest,
        ),
    )  # fmt: skip


def _sprung_slider() -> Case:
    """A body on a sloping rail with a spring and a damper, both partly a servo's."""
    stiffness, damping, rest, rate, mass = 40.0, 1.5, 0.2, 0.5, 2.0
    # Springs of 10 and 30 N/m to these places act like one of 40 N/m to 0.2 m.
    own, servo = 0.5, Servo("rail", (0.1,), stiffness=30.0, damping=1.0)
    axis, slack = (0.6, 0.0, -0.8), rest + mass * G * 0.8 / stiffness
    return case_of(
        "sprung slider",
        "spring and damper of a slider, and a servo's",
        [even("block", mass, 0.1)],
        lambda time: along(axis, slack + settling(stiffness, damping, mass, -slack, rate, time)),
        Joint(
            "rail", "slider", "world", "block", NONE, axis, rate=rate,
            stiffness=10.0, damping=0.5, rest=own,
        ),
        servos=(servo,),
    )  # fmt: skip


def _geared_axle() -> Case:
    """A motor with a rotor drives a wheel against a damper, and its free carrier back."""
    torque, damping, armature = 0.6, 0.2, 0.15
    inertia = _REDUCED + armature

    def turned(time: Array) -> Array:
        late = inertia / damping * (1.0 - np.exp(-damping / inertia * time))
        # The rotor has no momentum of its own, so the wheel's and the carrier's cancel.
        return -WHEEL / (CARRIER + WHEEL) * torque / damping * (time - late)

    return on_a_carrier(
        "geared axle",
        "armature of a hinge, its reaction",
        turned,
        Joint("axle", "hinge", "carrier", "wheel", NONE, UP, damping=damping, armature=armature),
        torques=(Torque("axle", (torque,)),),
    )


def _geared_rail() -> Case:
    """A block on a sloping rail drives a rotor, and a pendulum hangs on it.

    The pendulum's hinge has a rotor too. The start is the one of least kinetic energy.
    """
    block, bob, arm, rotor, rate = 2.0, 0.5, 0.4, 3.0, 0.7
    about = 0.02 + bob * arm**2
    swinging = 0.05
    coupled = bob * arm

    def rates(_: float, y: Array) -> Array:
        turn, _, spin = y[1], y[2], y[3]
        mass = np.array(
            [
                [block + bob + rotor, coupled * np.cos(turn)],
                [coupled * np.cos(turn), about + swinging],
            ]
        )
        load = [coupled * np.sin(turn) * spin**2, -bob * G * arm * np.sin(turn)]
        return np.array([y[2], y[3], *np.linalg.solve(mass, load)])

    def exact(time: Array) -> Array:
        spin = -coupled * rate / (about + swinging)
        along, turn = solve(rates, [0.0, 0.0, rate, spin], time)[:2]
        none = 0.0 * along
        cart = np.stack([along, none, none], axis=-1)
        return np.stack([cart, cart + arm * direction(turn)], axis=1)

    return case_of(
        "geared rail",
        "armature of a slider, and of hinges in the start of least kinetic energy",
        [even("block", block, 0.1), even("bob", bob, 0.02, (0.0, 0.0, -arm))],
        exact,
        Joint("rail", "slider", "world", "block", NONE, (1.0, 0.0, 0.0), rate=rate, armature=rotor),
        Joint("pin", "hinge", "block", "bob", NONE, (0.0, -1.0, 0.0), armature=swinging),
    )


def _led(inertia: float, joint: Joint, servo: Servo, time: Array) -> Array:
    """Solve for the coordinate of a sprung, damped joint that a servo leads, target by target."""
    whole, drag = joint.stiffness + servo.stiffness, joint.damping + servo.damping
    coordinate, start, rate = np.zeros_like(time), 0.0, 0.0
    span = servo.hold * Clock().frame
    for k, (target, speed) in enumerate(zip(servo.position, servo.velocity, strict=True)):
        pull = servo.stiffness * target + servo.damping * speed
        goal = (joint.stiffness * joint.rest + pull) / whole
        law, off, late = (whole, drag, inertia), start - goal, time - k * span
        later = late >= -1e-12
        coordinate[later] = goal + settling(*law, off, rate, late[later])
        # The rate obeys the same equation.
        bend = -(whole * off + drag * rate) / inertia
        (start,), (rate,) = (
            goal + settling(*law, off, rate, np.array([span])),
            settling(*law, rate, bend, np.array([span])),
        )
    return coordinate


_SPRUNG = {"stiffness": 2.0, "damping": 0.1, "rest": 0.4}
_LEADS = {"velocity": (0.3, 0.0), "stiffness": 30.0, "damping": 2.0, "hold": 25}


def _servo() -> Case:
    """An arm in the plane that a servo leads to two targets, one after the other.

    Its hinge also has a spring and a damper, with another rest angle.
    """
    mass, arm = 1.5, 0.4
    hub = Joint("hub", "hinge", "world", "arm", NONE, UP, **_SPRUNG)  # type: ignore[arg-type]
    servo = Servo("hub", (0.8, -0.5), **_LEADS)  # type: ignore[arg-type]
    return case_of(
        "servo",
        "position and velocity servo with held targets, beside a joint's own spring",
        [even("arm", mass, 0.05, (arm, 0.0, 0.0))],
        lambda time: arm * around(_led(0.05 + mass * arm**2, hub, servo, time))[:, None],
        hub,
        servos=(servo,),
        length=arm,
    )


def _led_block() -> Case:
    """A servo leads a block on a rail; the joint goes from the block to the world."""
    rail = Joint("rail", "slider", "block", "world", NONE, (-0.6, 0.0, 0.8), **_SPRUNG)  # type: ignore[arg-type]
    servo = Servo("rail", (0.3, -0.2), **_LEADS)  # type: ignore[arg-type]
    return case_of(
        "led block",
        "servo of a slider on the world with held targets",
        [even("block", 1.5, 0.1)],
        lambda time: along((0.6, 0.0, -0.8), _led(1.5, rail, servo, time)),
        rail,
        gravity=NONE,
        servos=(servo,),
    )


def _planetary() -> Case:
    """A motor on a free carrier turns a wheel, and through a gear another one.

    The total momentum about the mount stays 0; the motor's torque acts on the first wheel alone.
    """
    torque, ratio, arm, mass = 0.7, -2.5, 0.5, 0.8
    first, second = 0.3, 0.05
    carrier = 0.4 + 2 * mass * arm**2
    whole = carrier + first + second
    geared = first + ratio * second
    turning = torque / (first + ratio**2 * second - geared**2 / whole)

    def angles(time: Array) -> Array:
        wheel = 0.5 * turning * time**2
        mount = -geared / whole * wheel
        return np.stack([mount, mount + wheel, mount + ratio * wheel], axis=-1)

    def exact(time: Array) -> Array:
        tip = arm * around(angles(time)[:, 0])
        return np.stack([0.0 * tip, tip, -tip], axis=1)

    def orientation(time: Array) -> Array:
        return rotation.from_vector(angles(time)[..., None] * np.array(UP))

    return case_of(
        "planetary gear",
        "coupling of two hinges, its sign and reaction, whole turns",
        [
            even("carrier", 2.0, 0.4),
            even("wheel", mass, first, (arm, 0.0, 0.0)),
            even("pinion", mass, second, (-arm, 0.0, 0.0)),
        ],
        exact,
        Joint("mount", "hinge", "world", "carrier", NONE, UP, rate=0.0),
        Joint("axle", "hinge", "carrier", "wheel", (arm, 0.0, 0.0), UP),
        # From the outside inwards, and about the opposite axis: the coordinate is the same.
        Joint("shaft", "hinge", "pinion", "carrier", (-arm, 0.0, 0.0), (0.0, 0.0, -1.0)),
        orientation=orientation,
        gravity=NONE,
        torques=(Torque("axle", (torque,)),),
        couplings=(Coupling("shaft", "axle", ratio),),
    )


def _rack() -> Case:
    """A rack slides down a slope, and winds up a spring on the drum that it is coupled to."""
    mass, drum, radius, stiffness, rest, start, offset = 2.0, 0.02, 0.15, 3.0, 0.4, 0.2, 0.1
    axis, inertia = (0.6, 0.0, -0.8), drum + mass * radius**2
    slack = rest + mass * G * 0.8 * radius / stiffness

    def exact(time: Array) -> Array:
        angle = slack + settling(stiffness, 0.0, inertia, start - slack, 0.0, time)
        places = along(axis, offset + radius * angle)
        return np.concatenate([0.0 * places, places], axis=1)

    return case_of(
        "rack and pinion",
        "coupling of a slider and a hinge, its offset and the start that follows from it",
        [even("drum", 0.5, drum), even("rack", mass, 0.1)],
        exact,
        Joint(
            "axle", "hinge", "world", "drum", NONE, (0.0, 1.0, 0.0), start=start,
            stiffness=stiffness, rest=rest,
        ),
        Joint("rail", "slider", "world", "rack", NONE, axis),
        couplings=(Coupling("rail", "axle", radius, offset),),
    )  # fmt: skip


def _braked() -> Case:
    """A wheel on a free carrier is braked by dry friction until both turn together.

    Nothing else acts about the mount, so the momentum is the wheel's at the start.
    """
    friction, rate = 0.4, 5.0

    def turned(time: Array) -> Array:
        moving = np.minimum(time, rate * _REDUCED / friction)
        angle = rate * moving - 0.5 * friction / _REDUCED * moving**2
        return WHEEL * (rate * time - angle) / (CARRIER + WHEEL)

    return on_a_carrier(
        "brake",
        "dry friction of a hinge, its reaction, the time at which it stops",
        turned,
        Joint("axle", "hinge", "carrier", "wheel", NONE, UP, rate=rate, friction=friction),
    )


def _dragged() -> Case:
    """A sprung block slides back and forth on a rail against dry friction, until it sticks.

    Friction shifts the centre of each half swing, by the same amount either way. The block comes
    to rest at the first turning point from which the spring cannot pull it.
    """
    stiffness, mass, friction, start = 60.0, 1.5, 4.0, 0.5
    omega, shift = np.sqrt(stiffness / mass), friction / stiffness

    def exact(time: Array) -> Array:
        half = np.floor(time * omega / np.pi)
        # Amplitudes about the shifted points fall by two shifts each time, while positive.
        last = np.ceil((start / shift - 1.0) / 2.0)
        count = np.minimum(half, last)
        side = (-1.0) ** count
        rest, swing = side * (start - 2.0 * count * shift), start - (2.0 * count + 1.0) * shift
        moving = side * (swing * np.cos(omega * time - np.pi * count) + shift)
        return along((1.0, 0.0, 0.0), np.where(count < last, moving, rest))

    return case_of(
        "dragged block",
        "dry friction of a slider: its changes of sense, and where it sticks",
        [even("block", mass, 0.1)],
        exact,
        Joint(
            "rail", "slider", "world", "block", NONE, (1.0, 0.0, 0.0), start=start,
            stiffness=stiffness, friction=friction,
        ),
        gravity=NONE,
        clock=Clock(frame=0.02, steps=120),
    )  # fmt: skip


JOINT_CASES: tuple[Case, ...] = (
    _sprung_hinge(), _sprung_slider(), _geared_axle(), _geared_rail(), _servo(), _led_block(),
    _planetary(), _rack(), _braked(), _dragged(),
)  # fmt: skip
