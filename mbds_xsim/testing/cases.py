"""The ladder of small cases with exact answers, from free fall to a closed loop.

Each case says what it verifies. Answers are closed forms, or a textbook equation in one
generalised coordinate solved to 1e-12, never an engine. Spatial chains and loops have no such
answer: theirs is this package's reference, whose own tests hold it to answers from outside.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import reference
from mbds_xsim.base import rotation
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
)
from mbds_xsim.scene.state import Trajectory

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

_G = 9.81
_CLOCK = Clock(frame=0.02, steps=50)
_SHORT = Clock(frame=0.02, steps=30)
_BOX = (0.1, 0.4, 0.9)  # edges [m]
_BOX_MASS = 10.0


@dataclass(frozen=True)
class Case:
    """A scene and the exact motion of its bodies' centres of mass."""

    name: str
    verifies: str
    scene: Scene
    exact: Callable[[Array], Array]
    """Times [s], shape (frame,), to positions [m], shape (frame, body, 3)."""
    exact_orientation: Callable[[Array], Array] | None = None
    """To orientations, shape (frame, body, 4), where the case is about them."""


def _box(velocity: Vector | None = None, spin: Vector | None = None) -> Body:
    a, b, c = _BOX
    moments = (
        _BOX_MASS / 12 * (b * b + c * c),
        _BOX_MASS / 12 * (a * a + c * c),
        _BOX_MASS / 12 * (a * a + b * b),
    )
    inertia = Inertia(_BOX_MASS, moments)
    return Body("box", inertia=inertia, velocity=velocity, angular_velocity=spin)


def _free_fall() -> Case:
    velocity = np.array([1.0, -2.0, 3.0])
    scene = Scene(
        "free fall",
        bodies=(_box(velocity=(1.0, -2.0, 3.0), spin=(0.0, 0.0, 2.0)),),
        length=1.0,
        clock=_CLOCK,
    )

    def exact(time: Array) -> Array:
        return (time[:, None] * velocity - 0.5 * _G * time[:, None] ** 2 * [0, 0, 1])[:, None]

    return Case("free fall", "gravity, initial velocity, mass-independence", scene, exact)


def _tumbling() -> Case:
    """Euler's equations of the torque-free asymmetric top, spun about its middle axis."""
    spin = (0.1, 5.0, 0.1)
    scene = Scene(
        "tumbling",
        bodies=(_box(spin=spin),),
        length=1.0,
        gravity=(0.0, 0.0, 0.0),
        clock=_CLOCK,
    )
    inertia = scene.bodies[0].inertia
    assert inertia is not None
    moments = np.array(inertia.moments)

    def rate(_: float, y: Array) -> Array:
        q, w = y[:4], y[4:]  # w in the body
        turn = 0.5 * np.array(
            [
                -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
                q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
                q[0] * w[1] + q[3] * w[0] - q[1] * w[2],
                q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
            ]
        )
        return np.concatenate([turn, np.cross(moments * w, w) / moments])

    def orientation(time: Array) -> Array:
        return _solve(rate, [1.0, 0.0, 0.0, 0.0, *spin], time)[:4].T[:, None]

    return Case(
        "tumbling",
        "inertia axes, gyroscopic term, orientation convention",
        scene,
        lambda time: np.zeros((len(time), 1, 3)),
        orientation,
    )


_PUSHES = tuple((2.0 * (-1) ** k, 1.0 * k, -3.0) for k in range(10))
_SHARES = {"first": 1.0, "second": -2.0, "third": 0.5}


def _pushed() -> Case:
    """Boxes alike, each with a force of its own; listed in another order than their forces."""
    box = _box()
    scene = Scene(
        "pushed",
        bodies=tuple(msgspec.structs.replace(box, name=name) for name in _SHARES),
        length=1.0,
        gravity=(0.0, 0.0, 0.0),
        clock=_CLOCK,
        forces=tuple(
            Force(name, tuple((share * x, share * y, share * z) for x, y, z in _PUSHES), hold=5)
            for name, share in reversed(_SHARES.items())
        ),
    )
    verifies = "forces at the centres of mass of several bodies, held and switched"
    return Case("pushed", verifies, scene, _pushed_exact)


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
    scene = Scene(
        "rod",
        bodies=(Body("rod", particles=(particle,)),),
        joints=(Joint("pivot", "ball", "world", "rod", (0.0, 0.0, 0.0)),),
        length=length,
        clock=_CLOCK,
    )
    inertia = particle.inertia + particle.mass * length**2

    def exact(time: Array) -> Array:
        theta = _swing(angle, particle.mass * _G * length / inertia, time)
        return length * np.stack([np.sin(theta), 0 * theta, -np.cos(theta)], axis=-1)[:, None]

    return Case("rod", "ball joint, welded sphere's inertia", scene, exact)


def _hinge() -> Case:
    """Box on a skew hinge: only the moment about the axis counts."""
    axis = np.array([0.0, 0.6, 0.8])
    arm = np.array([0.3, 0.0, 0.0])
    scene = Scene(
        "hinge",
        bodies=(Body("box", inertia=_box().inertia, position=(0.3, 0.0, 0.0)),),
        joints=(Joint("hinge", "hinge", "world", "box", (0.0, 0.0, 0.0), axis=(0.0, 0.6, 0.8)),),
        length=0.5,
        clock=_CLOCK,
    )
    box = scene.bodies[0].inertia
    assert box is not None
    moment = axis @ np.diag(box.moments) @ axis + box.mass * arm @ arm
    side = np.cross(axis, arm)

    def exact(time: Array) -> Array:
        # x(θ) = arm cos θ + (axis × arm) sin θ; torque = −m g dz/dθ
        def acceleration(theta: float) -> float:
            lever = -arm[2] * np.sin(theta) + side[2] * np.cos(theta)
            return float(-box.mass * _G * lever / moment)

        theta = _integrate(acceleration, 0.0, 0.0, time)
        return (np.cos(theta)[:, None] * arm + np.sin(theta)[:, None] * side)[:, None]

    return Case("hinge", "hinge axis, inertia about it, its sign", scene, exact)


def _slider() -> Case:
    axis = np.array([0.6, 0.0, -0.8])
    scene = Scene(
        "slider",
        bodies=(_box(),),
        joints=(
            Joint("rail", "slider", "world", "box", (0.0, 0.0, 0.0), (0.6, 0.0, -0.8), rate=0.5),
        ),
        length=1.0,
        clock=_CLOCK,
    )

    def exact(time: Array) -> Array:
        along = 0.5 * time + 0.5 * 0.8 * _G * time**2
        return (along[:, None] * axis)[:, None]

    return Case("slider", "slider axis, initial rate", scene, exact)


def _spring() -> Case:
    """Sphere on a damped spring along x, a slider keeping it there."""
    stiffness, damping, mass, start = 40.0, 0.8, 1.0, 0.1
    scene = Scene(
        "spring",
        bodies=(Body("ball", particles=(Particle((1.0 + start, 0.0, 0.0)),)),),
        joints=(Joint("rail", "slider", "world", "ball", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),),
        springs=(
            SpringDamper(
                "spring",
                ("world", "ball"),
                ((0.0, 0.0, 0.0), (1.0 + start, 0.0, 0.0)),
                stiffness,
                damping,
                rest_length=1.0,
            ),
        ),
        length=1.0,
        clock=_CLOCK,
    )

    def exact(time: Array) -> Array:
        decay = damping / (2 * mass)
        omega = np.sqrt(stiffness / mass - decay**2)
        swing = np.cos(omega * time) + decay / omega * np.sin(omega * time)
        x = 1.0 + start * np.exp(-decay * time) * swing
        return np.stack([x, 0 * x, 0 * x], axis=-1)[:, None]

    return Case("spring", "spring and damper", scene, exact)


def _flywheel() -> Case:
    """A hinge torque spins a wheel up and its carrier back; a tip on an arm shows the carrier."""
    torque, carrier, wheel = 0.3, 0.4, 0.1
    arm = 0.5
    bodies = (
        Body("carrier", inertia=Inertia(2.0, (carrier, carrier, carrier))),
        Body("wheel", inertia=Inertia(1.0, (wheel, wheel, wheel))),
        Body("tip", inertia=Inertia(0.5, (0.01, 0.01, 0.01)), position=(arm, 0.0, 0.0)),
    )
    scene = Scene(
        "flywheel",
        bodies=bodies,
        gravity=(0.0, 0.0, 0.0),
        joints=(
            Joint("mount", "hinge", "world", "carrier", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            Joint("axle", "hinge", "carrier", "wheel", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            Joint("weld", "fixed", "carrier", "tip", (arm, 0.0, 0.0)),
        ),
        torques=(Torque("axle", (torque,)),),
        length=1.0,
        clock=_CLOCK,
    )
    moment = carrier + 0.01 + 0.5 * arm**2

    def exact(time: Array) -> Array:
        theta = -0.5 * torque / moment * time**2
        tip = arm * np.stack([np.cos(theta), np.sin(theta), 0 * theta], axis=-1)
        return np.stack([0 * tip, 0 * tip, tip], axis=1)

    return Case("flywheel", "hinge torque and its reaction, fixed joint", scene, exact)


def _spin_up_in_flight() -> Case:
    """A tumbling body spins its flywheel up and itself back, about an axle that turns with it.

    With moments alike about all axes the axle turns steadily about the angular momentum, as both
    did at first; about the axle the bodies turn as in the plane.
    """
    torque, carrier, wheel, mass = 1.0, 0.4, 0.1, 2.0
    axis, velocity = np.array([0.0, 0.6, 0.8]), np.array([1.0, -0.5, 2.0])
    spin = np.array([4.0, 1.0, -2.0])
    scene = Scene(
        "spin-up in flight",
        bodies=(
            Body(
                "carrier",
                inertia=Inertia(mass, (carrier,) * 3),
                velocity=(1.0, -0.5, 2.0),
                angular_velocity=(4.0, 1.0, -2.0),
            ),
            Body("wheel", inertia=Inertia(mass, (wheel,) * 3)),
        ),
        joints=(
            Joint("axle", "hinge", "carrier", "wheel", (0.0, 0.0, 0.0), (0.0, 0.6, 0.8), rate=0.0),
        ),
        torques=(Torque("axle", (torque,)),),
        length=1.0,
        clock=_CLOCK,
    )

    def exact(time: Array) -> Array:
        path = time[:, None] * velocity - 0.5 * _G * time[:, None] ** 2 * [0, 0, 1]
        return np.repeat(path[:, None], 2, axis=1)

    def orientation(time: Array) -> Array:
        angle = 0.5 * torque * time[:, None] ** 2 * [-1.0 / carrier, 1.0 / wheel]
        about_axle = rotation.from_vector(angle[..., None] * axis)
        return rotation.multiply(rotation.from_vector(time[:, None, None] * spin), about_axle)

    verifies = "angular momentum that a hinge torque moves between free bodies"
    return Case("spin-up in flight", verifies, scene, exact, orientation)


def _parallelogram() -> Case:
    """Two equal cranks and a coupler that only translates: one pendulum, closed by a hinge."""
    crank, width, angle = 0.5, 0.8, 1.0
    mass, inertia = 1.0, 0.02
    down = np.array([np.sin(angle), 0.0, -np.cos(angle)])

    def body(name: str, at: Array) -> Body:
        return Body(
            name,
            inertia=Inertia(mass, (inertia, inertia, inertia)),
            position=(float(at[0]), float(at[1]), float(at[2])),
        )

    def hinge(name: str, parent: str, child: str, at: Array) -> Joint:
        return Joint(
            name,
            "hinge",
            parent,
            child,
            (float(at[0]), float(at[1]), float(at[2])),
            axis=(0.0, 1.0, 0.0),
        )

    left, right = np.zeros(3), np.array([width, 0.0, 0.0])
    ends = (left + crank * down, right + crank * down)
    scene = Scene(
        "parallelogram",
        bodies=(
            body("left", left + 0.5 * crank * down),
            body("right", right + 0.5 * crank * down),
            body("coupler", 0.5 * (ends[0] + ends[1])),
        ),
        joints=(
            hinge("left pivot", "world", "left", left),
            hinge("right pivot", "world", "right", right),
            hinge("left pin", "left", "coupler", ends[0]),
            hinge("right pin", "right", "coupler", ends[1]),
        ),
        length=1.0,
        clock=_CLOCK,
    )
    moment = 2 * (inertia + mass * (crank / 2) ** 2) + mass * crank**2
    stiffness = (2 * mass * crank / 2 + mass * crank) * _G / moment

    def exact(time: Array) -> Array:
        theta = _swing(angle, stiffness, time)
        along = np.stack([np.sin(theta), 0 * theta, -np.cos(theta)], axis=-1)
        middle = np.array([width / 2, 0.0, 0.0])
        return np.stack(
            [0.5 * crank * along, right + 0.5 * crank * along, middle + crank * along], axis=1
        )

    return Case("parallelogram", "a loop closed by a hinge, redundant rows", scene, exact)


def _wedge() -> Case:
    """A block slides down a slope on a carriage: three sliders, two bodies, one freedom."""
    heavy, light = 3.0, 1.0

    def block(name: str, mass: float) -> Body:
        return Body(name, inertia=Inertia(mass, (0.1, 0.2, 0.3)), position=(0.0, 0.0, 1.0))

    def rail(name: str, parent: str, child: str, axis: Vector) -> Joint:
        return Joint(name, "slider", parent, child, (0.0, 0.0, 1.0), axis)

    scene = Scene(
        "wedge",
        bodies=(block("carriage", heavy), block("block", light)),
        joints=(
            rail("floor", "world", "carriage", (1.0, 0.0, 0.0)),
            rail("mast", "carriage", "block", (0.0, 0.0, 1.0)),
            rail("slope", "world", "block", (1.0, 0.0, -1.0)),
        ),
        length=1.0,
        clock=_CLOCK,
    )

    def exact(time: Array) -> Array:
        way = 0.5 * light * _G / (heavy + 2.0 * light) * time[:, None] ** 2
        along = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0]])
        return np.array([0.0, 0.0, 1.0]) + way[..., None] * along

    return Case("wedge", "a loop closed by a slider", scene, exact)


def _welded() -> Case:
    """Three bodies welded in a triangle spin up about a hinge as one."""
    torque, moment = 0.4, 0.02
    places = ((0.3, 0.0, 0.0), (-0.1, 0.2, 0.0), (-0.1, -0.3, 0.0))
    names = ("x", "y", "z")
    scene = Scene(
        "welded",
        bodies=tuple(
            Body(name, inertia=Inertia(1.0 + k, (moment,) * 3), position=place)
            for k, (name, place) in enumerate(zip(names, places, strict=True))
        ),
        joints=(
            Joint("axle", "hinge", "world", "x", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            *(Joint(f"weld {k}", "fixed", names[k - 1], names[k], places[k]) for k in range(3)),
        ),
        torques=(Torque("axle", (torque,)),),
        gravity=(0.0, 0.0, 0.0),
        length=1.0,
        clock=_CLOCK,
    )
    arms = np.array(places)
    whole = 3 * moment + np.array([1.0, 2.0, 3.0]) @ np.sum(arms**2, axis=1)

    def exact(time: Array) -> Array:
        angle = 0.5 * torque / whole * time[:, None] ** 2
        return rotation.rotate(rotation.from_vector(angle * [0.0, 0.0, 1.0])[:, None], arms)

    return Case("welded", "a loop closed by a fixed joint, under a hinge torque", scene, exact)


def _chain_of_balls() -> Case:
    """Unlike boxes thrown about their balls; the outer one turns by more than half a turn."""
    scene = Scene(
        "chain of balls",
        bodies=(
            _brick("inner", (0.3, 0.1, 0.0), spin=(1.0, -2.0, 0.5)),
            _brick("middle", (0.6, 0.3, 0.2), spin=(-1.0, 1.0, 3.0)),
            _brick("outer", (0.8, 0.2, 0.5), spin=(6.0, 5.0, -3.0)),
        ),
        joints=(
            Joint("hook", "ball", "world", "inner", (0.1, 0.0, 0.0)),
            Joint("first", "ball", "inner", "middle", (0.5, 0.2, 0.0)),
            # Against the tree's direction.
            Joint("second", "ball", "outer", "middle", (0.7, 0.3, 0.3)),
        ),
        forces=(
            Force("inner", ((3.0, 0.0, 1.0),)),
            Force("middle", ((0.0, -4.0, 2.0),)),
            Force("outer", ((-2.0, 1.0, 0.0),)),
        ),
        length=1.0,
        clock=_SHORT,
    )
    return _referenced("ball joints in space, forces on what they carry", scene)


def _ball_loop() -> Case:
    """Two bodies that swing about the line of their hooks, and each about its own two balls."""
    scene = Scene(
        "ball loop",
        bodies=(
            _brick("left", (0.2, 0.1, -0.3), spin=(3.2, 0.6, -1.5)),
            _brick("right", (0.6, -0.1, -0.4)),
        ),
        joints=(
            Joint("left hook", "ball", "world", "left", (0.0, 0.0, 0.0)),
            Joint("middle", "ball", "left", "right", (0.4, 0.2, -0.5)),
            Joint("right hook", "ball", "right", "world", (0.9, 0.0, 0.0)),
        ),
        length=1.0,
        clock=_SHORT,
    )
    return _referenced("a loop in space closed by a ball at the world", scene)


def _hooke() -> Case:
    """Two shafts at an angle and a cross between them: four hinges through one point.

    The last bearing closes the loop and drives it. Closed by a ball joint there the second shaft
    would turn freely about the point.
    """
    bend = 0.6
    out = (float(np.cos(bend)), 0.0, float(np.sin(bend)))
    across = (-float(np.sin(bend)), 0.0, float(np.cos(bend)))
    middle = (0.0, 0.0, 0.0)
    scene = Scene(
        "Hooke's joint",
        bodies=(
            _brick("driven", (-0.3, 0.1, 0.0)),
            _brick("cross", (0.0, 0.0, 0.05)),
            _brick("driving", (0.3 * out[0], -0.1, 0.3 * out[2])),
        ),
        joints=(
            Joint("bearing", "hinge", "world", "driven", middle, (1.0, 0.0, 0.0), rate=4.0),
            Joint("yoke", "hinge", "driven", "cross", middle, (0.0, 1.0, 0.0)),
            Joint("other yoke", "hinge", "cross", "driving", middle, across),
            Joint("other bearing", "hinge", "driving", "world", middle, out),
        ),
        torques=(Torque("other bearing", (0.5,)),),
        length=0.6,
        clock=_SHORT,
    )
    return _referenced("a loop in space closed by a hinge at the world, which is driven", scene)


def _linked() -> Case:
    """One body on a ball tows another that flies."""
    scene = Scene(
        "linked",
        bodies=(
            _brick("hung", (0.2, 0.0, -0.2), spin=(0.0, 3.0, 1.0)),
            _brick("thrown", (0.7, 0.1, -0.4), velocity=(0.0, 1.5, 0.0)),
        ),
        joints=(Joint("hook", "ball", "world", "hung", (0.0, 0.0, 0.0)),),
        distance_links=(
            DistanceLink("link", ("hung", "thrown"), ((0.3, 0.1, -0.2), (0.6, 0.2, -0.3))),
        ),
        length=1.0,
        clock=_SHORT,
    )
    return _referenced("a distance link between points off the centres of mass", scene)


def _brick(
    name: str, at: Vector, velocity: Vector | None = None, spin: Vector | None = None
) -> Body:
    """Make a body with an inertia that is along no axis of its frame."""
    inertia = Inertia(1.0 + abs(at[0]), (0.03, 0.05, 0.04), (0.01, -0.004, 0.006))
    return Body(name, inertia=inertia, position=at, velocity=velocity, angular_velocity=spin)


def _referenced(verifies: str, scene: Scene) -> Case:
    """Hold a scene against the reference, which knows it at its frames."""
    return Case(
        scene.name,
        verifies,
        scene,
        lambda _: _reference(scene).position[0],
        lambda _: _reference(scene).orientation[0],
    )


@functools.cache
def _reference(scene: Scene) -> Trajectory:
    return reference.solve(scene, draw_batch(scene, [0]), cache=False)


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
