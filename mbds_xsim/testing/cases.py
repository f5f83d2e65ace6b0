"""The ladder of small cases with exact answers, from free fall to a closed loop.

Each case states what it verifies. Answers are closed forms, textbook equations solved to 1e-12, or
in spatial chains and loops the reference's motion, but never an engine's.
"""

from __future__ import annotations

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Body, Force, Inertia, Joint, Particle, SpringDamper, Torque
from mbds_xsim.testing.case import NONE, Case, G, case_of, direction, even, integrate, solve, swing
from mbds_xsim.testing.joint_cases import CARRIER, JOINT_CASES, UP, along, on_a_carrier, settling
from mbds_xsim.testing.limit_cases import SERVO_CASES, STOP_CASES
from mbds_xsim.testing.loop_cases import LOOPS

_BOX = (0.1, 0.4, 0.9)  # edges [m]
_BOX_MASS = 10.0
_BOX_INERTIA = Inertia(
    _BOX_MASS,
    (
        _BOX_MASS / 12 * (_BOX[1] ** 2 + _BOX[2] ** 2),
        _BOX_MASS / 12 * (_BOX[0] ** 2 + _BOX[2] ** 2),
        _BOX_MASS / 12 * (_BOX[0] ** 2 + _BOX[1] ** 2),
    ),
)


def _free_fall() -> Case:
    velocity = (1.0, -2.0, 3.0)
    return case_of(
        "free fall",
        "gravity, initial velocity, mass-independence",
        [Body("box", inertia=_BOX_INERTIA, velocity=velocity, angular_velocity=(0.0, 0.0, 2.0))],
        lambda time: _flight(velocity, time)[:, None],
    )


def _flight(velocity: tuple[float, ...], time: Array) -> Array:
    return time[:, None] * np.array(velocity) - 0.5 * G * time[:, None] ** 2 * [0, 0, 1]


def _tumbling() -> Case:
    """Euler's equations of the torque-free asymmetric top, spun about its middle axis."""
    spin = (0.1, 5.0, 0.1)
    moments = np.array(_BOX_INERTIA.moments)

    def rate(_: float, y: Array) -> Array:
        q, w = y[:4], y[4:]  # w in the body's frame
        turn = 0.5 * rotation.multiply(q, np.concatenate([[0.0], w]))
        return np.concatenate([turn, np.cross(moments * w, w) / moments])

    return case_of(
        "tumbling",
        "inertia axes, gyroscopic term, orientation convention",
        [Body("box", inertia=_BOX_INERTIA, angular_velocity=spin)],
        lambda time: np.zeros((len(time), 1, 3)),
        orientation=lambda time: solve(rate, [1.0, 0.0, 0.0, 0.0, *spin], time)[:4].T[:, None],
        gravity=NONE,
    )


_PUSHES = tuple((2.0 * (-1) ** k, 1.0 * k, -3.0) for k in range(10))
_SHARES = {"first": 1.0, "second": -2.0, "third": 0.5}


def _pushed() -> Case:
    """Equal boxes, each with a force of its own; the forces are listed in another order."""
    return case_of(
        "pushed",
        "forces at the centres of mass of several bodies, held and switched",
        [Body(name, inertia=_BOX_INERTIA) for name in _SHARES],
        _pushed_exact,
        gravity=NONE,
        forces=tuple(
            Force(name, tuple((share * x, share * y, share * z) for x, y, z in _PUSHES), hold=5)
            for name, share in reversed(_SHARES.items())
        ),
    )


def _pushed_exact(time: Array) -> Array:
    hold = 0.1
    x, v = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    for k, push in enumerate(_PUSHES):
        lasted = np.clip(time - k * hold, 0.0, hold)[:, None]
        acceleration = np.array(push) / _BOX_MASS
        x += v * lasted + 0.5 * acceleration * lasted**2
        v += acceleration * lasted
    return x[:, None] * np.array(list(_SHARES.values()))[:, None]


def _rod() -> Case:
    """Point-like sphere on a massless rod: I θ'' = −m g L sin θ about the pivot."""
    length, angle = 0.5, 1.2
    particle = Particle((length * np.sin(angle), 0.0, -length * np.cos(angle)))
    inertia = particle.inertia + particle.mass * length**2

    def exact(time: Array) -> Array:
        theta = swing(angle, particle.mass * G * length / inertia, time)
        return length * direction(theta)[:, None]

    return case_of(
        "rod",
        "ball joint, welded sphere's inertia",
        [Body("rod", particles=(particle,))],
        exact,
        Joint("pivot", "ball", "world", "rod", NONE),
        length=length,
    )


def _hinge() -> Case:
    """Box on a skew hinge: only the moment about the axis counts."""
    axis, arm = np.array([0.0, 0.6, 0.8]), np.array([0.3, 0.0, 0.0])
    moment = axis @ np.diag(_BOX_INERTIA.moments) @ axis + _BOX_MASS * arm @ arm
    side = np.cross(axis, arm)

    def acceleration(theta: float) -> float:
        # x(θ) = arm cos θ + (axis × arm) sin θ; torque = −m g dz/dθ
        lever = -arm[2] * np.sin(theta) + side[2] * np.cos(theta)
        return float(-_BOX_MASS * G * lever / moment)

    def exact(time: Array) -> Array:
        theta = integrate(acceleration, 0.0, 0.0, time)
        return (np.cos(theta)[:, None] * arm + np.sin(theta)[:, None] * side)[:, None]

    return case_of(
        "hinge",
        "hinge axis, inertia about it, its sign",
        [Body("box", inertia=_BOX_INERTIA, position=(0.3, 0.0, 0.0))],
        exact,
        Joint("hinge", "hinge", "world", "box", NONE, axis=(0.0, 0.6, 0.8)),
        length=0.5,
    )


def _slider() -> Case:
    axis = (0.6, 0.0, -0.8)
    return case_of(
        "slider",
        "slider axis, initial rate",
        [Body("box", inertia=_BOX_INERTIA)],
        lambda time: along(axis, 0.5 * time + 0.5 * 0.8 * G * time**2),
        Joint("rail", "slider", "world", "box", NONE, axis, rate=0.5),
    )


def _spring() -> Case:
    """Sphere on a damped spring along x, kept there by a slider."""
    stiffness, damping, mass, start = 40.0, 0.8, 1.0, 0.1
    place, axis = (1.0 + start, 0.0, 0.0), (1.0, 0.0, 0.0)
    ends, points = ("world", "ball"), (NONE, place)
    return case_of(
        "spring",
        "spring and damper",
        [Body("ball", particles=(Particle(place),))],
        lambda time: along(axis, 1.0 + settling(stiffness, damping, mass, start, 0.0, time)),
        Joint("rail", "slider", "world", "ball", NONE, axis),
        springs=(SpringDamper("spring", ends, points, stiffness, damping, rest_length=1.0),),
    )


def _flywheel() -> Case:
    """A hinge torque spins a wheel up and its carrier back."""
    torque = 0.3
    return on_a_carrier(
        "flywheel",
        "hinge torque and its reaction, fixed joint",
        lambda time: -0.5 * torque / CARRIER * time**2,
        Joint("axle", "hinge", "carrier", "wheel", NONE, UP),
        torques=(Torque("axle", (torque,)),),
    )


def _spin_up_in_flight() -> Case:
    """A tumbling body spins its flywheel up and itself back, about an axle that turns with it.

    Moments are equal about all axes, so the axle turns steadily about the angular momentum, as
    both bodies did at first; about the axle, the bodies turn as in the plane.
    """
    torque, carrier, wheel, mass = 1.0, 0.4, 0.1, 2.0
    axis, velocity, spin = (0.0, 0.6, 0.8), (1.0, -0.5, 2.0), (4.0, 1.0, -2.0)

    def orientation(time: Array) -> Array:
        angle = 0.5 * torque * time[:, None] ** 2 * [-1.0 / carrier, 1.0 / wheel]
        about_axle = rotation.from_vector(angle[..., None] * np.array(axis))
        whole = rotation.from_vector(time[:, None, None] * np.array(spin))
        return rotation.multiply(whole, about_axle)

    thrown = even("carrier", mass, carrier)
    return case_of(
        "spin-up in flight",
        "angular momentum that a hinge torque moves between free bodies",
        [
            msgspec.structs.replace(thrown, velocity=velocity, angular_velocity=spin),
            even("wheel", mass, wheel),
        ],
        lambda time: np.repeat(_flight(velocity, time)[:, None], 2, axis=1),
        Joint("axle", "hinge", "carrier", "wheel", NONE, axis, rate=0.0),
        orientation=orientation,
        torques=(Torque("axle", (torque,)),),
    )


CASES: tuple[Case, ...] = (
    _free_fall(), _tumbling(), _pushed(), _rod(), _hinge(), _slider(), _spring(), _flywheel(),
    _spin_up_in_flight(), *JOINT_CASES, *SERVO_CASES, *STOP_CASES, *LOOPS,
)  # fmt: skip
