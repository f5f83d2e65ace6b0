"""The ladder of small cases with exact answers, from free fall to a closed loop.

Each case says what it verifies. Answers are closed forms, or a textbook equation in one
generalised coordinate solved to 1e-12, never an engine. Spatial chains and loops have no such
answer: theirs is this package's reference, whose own tests hold it to answers from outside.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    DistanceLink,
    Force,
    Inertia,
    Joint,
    Particle,
    Scene,
    SpringDamper,
    Torque,
    Vector,
)
from mbds_xsim.scene.state import Trajectory

Exact = Callable[[Array], Array]

_G = 9.81
_NONE: Vector = (0.0, 0.0, 0.0)
_CLOCK = Clock(frame=0.02, steps=50)
_BOX = (0.1, 0.4, 0.9)  # edges [m]
_BOX_MASS = 10.0


@dataclass(frozen=True)
class Case:
    """A scene and the exact motion of its bodies' centres of mass."""

    name: str
    verifies: str
    scene: Scene
    exact: Exact
    """Times [s], shape (frame,), to positions [m], shape (frame, body, 3)."""
    exact_orientation: Exact | None = None
    """To orientations, shape (frame, body, 4), where the case is about them."""


_BOX_INERTIA = Inertia(
    _BOX_MASS,
    (
        _BOX_MASS / 12 * (_BOX[1] ** 2 + _BOX[2] ** 2),
        _BOX_MASS / 12 * (_BOX[0] ** 2 + _BOX[2] ** 2),
        _BOX_MASS / 12 * (_BOX[0] ** 2 + _BOX[1] ** 2),
    ),
)


def _box(velocity: Vector | None = None, spin: Vector | None = None) -> Body:
    return Body("box", inertia=_BOX_INERTIA, velocity=velocity, angular_velocity=spin)


def _case(
    name: str,
    verifies: str,
    bodies: Sequence[Body],
    exact: Exact,
    *joints: Joint,
    orientation: Exact | None = None,
    length: float = 1.0,
    clock: Clock = _CLOCK,
    **more: Any,
) -> Case:
    """Make a case of bodies that joints hold; `more` are other fields of its scene."""
    scene = Scene(name, tuple(bodies), length, joints=joints, clock=clock, **more)
    return Case(name, verifies, scene, exact, orientation)


def _free_fall() -> Case:
    velocity = (1.0, -2.0, 3.0)
    return _case(
        "free fall",
        "gravity, initial velocity, mass-independence",
        [_box(velocity, spin=(0.0, 0.0, 2.0))],
        lambda time: _flight(velocity, time)[:, None],
    )


def _flight(velocity: Vector, time: Array) -> Array:
    return time[:, None] * np.array(velocity) - 0.5 * _G * time[:, None] ** 2 * [0, 0, 1]


def _tumbling() -> Case:
    """Euler's equations of the torque-free asymmetric top, spun about its middle axis."""
    spin = (0.1, 5.0, 0.1)
    moments = np.array(_BOX_INERTIA.moments)

    def rate(_: float, y: Array) -> Array:
        q, w = y[:4], y[4:]  # w in the body
        turn = 0.5 * rotation.multiply(q, np.concatenate([[0.0], w]))
        return np.concatenate([turn, np.cross(moments * w, w) / moments])

    return _case(
        "tumbling",
        "inertia axes, gyroscopic term, orientation convention",
        [_box(spin=spin)],
        lambda time: np.zeros((len(time), 1, 3)),
        orientation=lambda time: _solve(rate, [1.0, 0.0, 0.0, 0.0, *spin], time)[:4].T[:, None],
        gravity=_NONE,
    )


_PUSHES = tuple((2.0 * (-1) ** k, 1.0 * k, -3.0) for k in range(10))
_SHARES = {"first": 1.0, "second": -2.0, "third": 0.5}


def _pushed() -> Case:
    """Boxes alike, each with a force of its own; listed in another order than their forces."""
    return _case(
        "pushed",
        "forces at the centres of mass of several bodies, held and switched",
        [Body(name, inertia=_BOX_INERTIA) for name in _SHARES],
        _pushed_exact,
        gravity=_NONE,
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
        theta = _swing(angle, particle.mass * _G * length / inertia, time)
        return length * _down(theta)[:, None]

    return _case(
        "rod",
        "ball joint, welded sphere's inertia",
        [Body("rod", particles=(particle,))],
        exact,
        Joint("pivot", "ball", "world", "rod", _NONE),
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
        return float(-_BOX_MASS * _G * lever / moment)

    def exact(time: Array) -> Array:
        theta = _integrate(acceleration, 0.0, 0.0, time)
        return (np.cos(theta)[:, None] * arm + np.sin(theta)[:, None] * side)[:, None]

    return _case(
        "hinge",
        "hinge axis, inertia about it, its sign",
        [Body("box", inertia=_BOX_INERTIA, position=(0.3, 0.0, 0.0))],
        exact,
        Joint("hinge", "hinge", "world", "box", _NONE, axis=(0.0, 0.6, 0.8)),
        length=0.5,
    )


def _slider() -> Case:
    def exact(time: Array) -> Array:
        along = 0.5 * time + 0.5 * 0.8 * _G * time**2
        return (along[:, None] * np.array([0.6, 0.0, -0.8]))[:, None]

    return _case(
        "slider",
        "slider axis, initial rate",
        [_box()],
        exact,
        Joint("rail", "slider", "world", "box", _NONE, (0.6, 0.0, -0.8), rate=0.5),
    )


def _spring() -> Case:
    """Sphere on a damped spring along x, a slider keeping it there."""
    stiffness, damping, mass, start = 40.0, 0.8, 1.0, 0.1
    place = (1.0 + start, 0.0, 0.0)

    def exact(time: Array) -> Array:
        decay = damping / (2 * mass)
        omega = np.sqrt(stiffness / mass - decay**2)
        swing = np.cos(omega * time) + decay / omega * np.sin(omega * time)
        x = 1.0 + start * np.exp(-decay * time) * swing
        return np.stack([x, 0 * x, 0 * x], axis=-1)[:, None]

    ends, points = ("world", "ball"), (_NONE, place)
    return _case(
        "spring",
        "spring and damper",
        [Body("ball", particles=(Particle(place),))],
        exact,
        Joint("rail", "slider", "world", "ball", _NONE, (1.0, 0.0, 0.0)),
        springs=(SpringDamper("spring", ends, points, stiffness, damping, rest_length=1.0),),
    )


def _flywheel() -> Case:
    """A hinge torque spins a wheel up and its carrier back; a tip on an arm shows the carrier."""
    torque, carrier, wheel, arm = 0.3, 0.4, 0.1, 0.5
    moment = carrier + 0.01 + 0.5 * arm**2

    def exact(time: Array) -> Array:
        theta = -0.5 * torque / moment * time**2
        tip = arm * np.stack([np.cos(theta), np.sin(theta), 0 * theta], axis=-1)
        return np.stack([0 * tip, 0 * tip, tip], axis=1)

    return _case(
        "flywheel",
        "hinge torque and its reaction, fixed joint",
        [
            _even("carrier", 2.0, carrier),
            _even("wheel", 1.0, wheel),
            _even("tip", 0.5, 0.01, (arm, 0.0, 0.0)),
        ],
        exact,
        Joint("mount", "hinge", "world", "carrier", _NONE, (0.0, 0.0, 1.0)),
        Joint("axle", "hinge", "carrier", "wheel", _NONE, (0.0, 0.0, 1.0)),
        Joint("weld", "fixed", "carrier", "tip", (arm, 0.0, 0.0)),
        gravity=_NONE,
        torques=(Torque("axle", (torque,)),),
    )


def _spin_up_in_flight() -> Case:
    """A tumbling body spins its flywheel up and itself back, about an axle that turns with it.

    With moments alike about all axes the axle turns steadily about the angular momentum, as both
    did at first; about the axle the bodies turn as in the plane.
    """
    torque, carrier, wheel, mass = 1.0, 0.4, 0.1, 2.0
    axis, velocity, spin = (0.0, 0.6, 0.8), (1.0, -0.5, 2.0), (4.0, 1.0, -2.0)

    def orientation(time: Array) -> Array:
        angle = 0.5 * torque * time[:, None] ** 2 * [-1.0 / carrier, 1.0 / wheel]
        about_axle = rotation.from_vector(angle[..., None] * np.array(axis))
        whole = rotation.from_vector(time[:, None, None] * np.array(spin))
        return rotation.multiply(whole, about_axle)

    thrown = _even("carrier", mass, carrier)
    return _case(
        "spin-up in flight",
        "angular momentum that a hinge torque moves between free bodies",
        [
            msgspec.structs.replace(thrown, velocity=velocity, angular_velocity=spin),
            _even("wheel", mass, wheel),
        ],
        lambda time: np.repeat(_flight(velocity, time)[:, None], 2, axis=1),
        Joint("axle", "hinge", "carrier", "wheel", _NONE, axis, rate=0.0),
        orientation=orientation,
        torques=(Torque("axle", (torque,)),),
    )


def _parallelogram() -> Case:
    """Two equal cranks and a coupler that only translates: one pendulum, closed by a hinge."""
    crank, width, angle = 0.5, 0.8, 1.0
    mass, inertia = 1.0, 0.02
    down = _down(np.array(angle))
    left, right = np.zeros(3), np.array([width, 0.0, 0.0])
    ends = (left + crank * down, right + crank * down)

    def body(name: str, at: Array) -> Body:
        return _even(name, mass, inertia, _vector(at))

    def hinge(name: str, parent: str, child: str, at: Array) -> Joint:
        return Joint(name, "hinge", parent, child, _vector(at), axis=(0.0, 1.0, 0.0))

    moment = 2 * (inertia + mass * (crank / 2) ** 2) + mass * crank**2
    stiffness = (2 * mass * crank / 2 + mass * crank) * _G / moment

    def exact(time: Array) -> Array:
        along = _down(_swing(angle, stiffness, time))
        middle = np.array([width / 2, 0.0, 0.0])
        return np.stack(
            [0.5 * crank * along, right + 0.5 * crank * along, middle + crank * along], axis=1
        )

    return _case(
        "parallelogram",
        "a loop closed by a hinge, redundant rows",
        [
            body("left", left + 0.5 * crank * down),
            body("right", right + 0.5 * crank * down),
            body("coupler", 0.5 * (ends[0] + ends[1])),
        ],
        exact,
        hinge("left pivot", "world", "left", left),
        hinge("right pivot", "world", "right", right),
        hinge("left pin", "left", "coupler", ends[0]),
        hinge("right pin", "right", "coupler", ends[1]),
    )


def _wedge() -> Case:
    """A block slides down a slope on a carriage: three sliders, two bodies, one freedom."""
    heavy, light = 3.0, 1.0
    place = (0.0, 0.0, 1.0)

    def exact(time: Array) -> Array:
        way = 0.5 * light * _G / (heavy + 2.0 * light) * time[:, None] ** 2
        along = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0]])
        return np.array(place) + way[..., None] * along

    return _case(
        "wedge",
        "a loop closed by a slider",
        [
            Body(name, inertia=Inertia(mass, (0.1, 0.2, 0.3)), position=place)
            for name, mass in (("carriage", heavy), ("block", light))
        ],
        exact,
        Joint("floor", "slider", "world", "carriage", place, (1.0, 0.0, 0.0)),
        Joint("mast", "slider", "carriage", "block", place, (0.0, 0.0, 1.0)),
        Joint("slope", "slider", "world", "block", place, (1.0, 0.0, -1.0)),
    )


def _welded() -> Case:
    """Three bodies welded in a triangle spin up about a hinge as one."""
    torque, moment = 0.4, 0.02
    places = ((0.3, 0.0, 0.0), (-0.1, 0.2, 0.0), (-0.1, -0.3, 0.0))
    names, arms = ("x", "y", "z"), np.array(places)
    whole = 3 * moment + np.array([1.0, 2.0, 3.0]) @ np.sum(arms**2, axis=1)

    def exact(time: Array) -> Array:
        angle = 0.5 * torque / whole * time[:, None] ** 2
        return rotation.rotate(rotation.from_vector(angle * [0.0, 0.0, 1.0])[:, None], arms)

    return _case(
        "welded",
        "a loop closed by a fixed joint, under a hinge torque",
        [_even(names[k], 1.0 + k, moment, places[k]) for k in range(3)],
        exact,
        Joint("axle", "hinge", "world", "x", _NONE, (0.0, 0.0, 1.0)),
        *(Joint(f"weld {k}", "fixed", names[k - 1], names[k], places[k]) for k in range(3)),
        torques=(Torque("axle", (torque,)),),
        gravity=_NONE,
    )


def _even(name: str, mass: float, moment: float, at: Vector = _NONE) -> Body:
    """Make a body with moments alike about all axes."""
    return Body(name, inertia=Inertia(mass, (moment,) * 3), position=at)


def _down(angle: Array) -> Array:
    """Directions at angles from −z towards x."""
    return np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)


def _vector(place: Array) -> Vector:
    x, y, z = place.tolist()
    return (x, y, z)


def _chain_of_balls() -> Case:
    """Unlike boxes thrown about their balls; the outer one turns by more than half a turn."""
    return _referenced(
        "chain of balls",
        "ball joints in space, forces on what they carry",
        [
            _brick("inner", (0.3, 0.1, 0.0), spin=(1.0, -2.0, 0.5)),
            _brick("middle", (0.6, 0.3, 0.2), spin=(-1.0, 1.0, 3.0)),
            _brick("outer", (0.8, 0.2, 0.5), spin=(6.0, 5.0, -3.0)),
        ],
        Joint("hook", "ball", "world", "inner", (0.1, 0.0, 0.0)),
        Joint("first", "ball", "inner", "middle", (0.5, 0.2, 0.0)),
        # Against the tree's direction.
        Joint("second", "ball", "outer", "middle", (0.7, 0.3, 0.3)),
        forces=(
            Force("inner", ((3.0, 0.0, 1.0),)),
            Force("middle", ((0.0, -4.0, 2.0),)),
            Force("outer", ((-2.0, 1.0, 0.0),)),
        ),
    )


def _ball_loop() -> Case:
    """Two bodies that swing about the line of their hooks, and each about its own two balls."""
    return _referenced(
        "ball loop",
        "a loop in space closed by a ball at the world",
        [
            _brick("left", (0.2, 0.1, -0.3), spin=(3.2, 0.6, -1.5)),
            _brick("right", (0.6, -0.1, -0.4)),
        ],
        Joint("left hook", "ball", "world", "left", _NONE),
        Joint("middle", "ball", "left", "right", (0.4, 0.2, -0.5)),
        Joint("right hook", "ball", "right", "world", (0.9, 0.0, 0.0)),
    )


def _hooke() -> Case:
    """Two shafts at an angle and a cross between them: four hinges through one point.

    The last bearing closes the loop and drives it. Closed by a ball joint there the second shaft
    would turn freely about the point.
    """
    bend = 0.6
    out = (float(np.cos(bend)), 0.0, float(np.sin(bend)))
    across = (-out[2], 0.0, out[0])
    return _referenced(
        "Hooke's joint",
        "a loop in space closed by a hinge at the world, which is driven",
        [
            _brick("driven", (-0.3, 0.1, 0.0)),
            _brick("cross", (0.0, 0.0, 0.05)),
            _brick("driving", (0.3 * out[0], -0.1, 0.3 * out[2])),
        ],
        Joint("bearing", "hinge", "world", "driven", _NONE, (1.0, 0.0, 0.0), rate=4.0),
        Joint("yoke", "hinge", "driven", "cross", _NONE, (0.0, 1.0, 0.0)),
        Joint("other yoke", "hinge", "cross", "driving", _NONE, across),
        Joint("other bearing", "hinge", "driving", "world", _NONE, out),
        torques=(Torque("other bearing", (0.5,)),),
        length=0.6,
    )


def _linked() -> Case:
    """One body on a ball tows another that flies."""
    ends, points = ("hung", "thrown"), ((0.3, 0.1, -0.2), (0.6, 0.2, -0.3))
    return _referenced(
        "linked",
        "a distance link between points off the centres of mass",
        [
            _brick("hung", (0.2, 0.0, -0.2), spin=(0.0, 3.0, 1.0)),
            _brick("thrown", (0.7, 0.1, -0.4), velocity=(0.0, 1.5, 0.0)),
        ],
        Joint("hook", "ball", "world", "hung", _NONE),
        distance_links=(DistanceLink("link", ends, points),),
    )


def _brick(
    name: str, at: Vector, velocity: Vector | None = None, spin: Vector | None = None
) -> Body:
    """Make a body with an inertia that is along no axis of its frame."""
    inertia = Inertia(1.0 + abs(at[0]), (0.03, 0.05, 0.04), (0.01, -0.004, 0.006))
    return Body(name, inertia=inertia, position=at, velocity=velocity, angular_velocity=spin)


def _referenced(
    name: str, verifies: str, bodies: Sequence[Body], *joints: Joint, **more: Any
) -> Case:
    """Hold a scene against the reference, which knows it at its frames."""

    @functools.cache
    def solved() -> Trajectory:
        return reference.solve(case.scene, draw_batch(case.scene, [0]), cache=False)

    case = _case(
        name,
        verifies,
        bodies,
        lambda _: solved().position[0],
        *joints,
        orientation=lambda _: solved().orientation[0],
        clock=Clock(frame=0.02, steps=30),
        **more,
    )
    return case


def _swing(start: float, stiffness: float, time: Array) -> Array:
    """θ'' = −stiffness · sin θ from rest."""
    return _integrate(lambda theta: -stiffness * np.sin(theta), start, 0.0, time)


def _integrate(
    acceleration: Callable[[float], float], start: float, rate: float, time: Array
) -> Array:
    return _solve(lambda _, y: np.array([y[1], acceleration(y[0])]), [start, rate], time)[0]


def _solve(rate: Callable[[float, Array], Array], start: list[float], time: Array) -> Array:
    from scipy.integrate import solve_ivp

    span = (0.0, float(time[-1]))
    solution = solve_ivp(rate, span, start, method="DOP853", t_eval=time, rtol=1e-12, atol=1e-13)
    return np.asarray(solution.y)


CASES: tuple[Case, ...] = (
    _free_fall(),
    _tumbling(),
    _pushed(),
    _rod(),
    _hinge(),
    _slider(),
    _spring(),
    _flywheel(),
    _spin_up_in_flight(),
    _parallelogram(),
    _chain_of_balls(),
    _ball_loop(),
    _hooke(),
    _linked(),
    _wedge(),
    _welded(),
)
