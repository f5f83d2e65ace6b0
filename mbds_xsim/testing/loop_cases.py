"""Cases of loops and of chains in space.

Loops in the plane have closed forms. Spatial chains and loops have none: their answers are those of
this package's reference, which its own tests compare with independent answers.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Force, Inertia, Joint, Torque, Vector
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.testing.case import NONE, Case, G, case_of, direction, even, swing


def _parallelogram() -> Case:
    """Two equal cranks and a coupler that only translates: one pendulum, closed by a hinge."""
    crank, width, angle = 0.5, 0.8, 1.0
    mass, inertia = 1.0, 0.02
    down = direction(np.array(angle))
    left, right = np.zeros(3), np.array([width, 0.0, 0.0])
    ends = (left + crank * down, right + crank * down)

    def body(name: str, at: Array) -> Body:
        return even(name, mass, inertia, _vector(at))

    def hinge(name: str, parent: str, child: str, at: Array) -> Joint:
        return Joint(name, "hinge", parent, child, _vector(at), axis=(0.0, 1.0, 0.0))

    moment = 2 * (inertia + mass * (crank / 2) ** 2) + mass * crank**2
    stiffness = (2 * mass * crank / 2 + mass * crank) * G / moment

    def exact(time: Array) -> Array:
        along = direction(swing(angle, stiffness, time))
        middle = np.array([width / 2, 0.0, 0.0])
        return np.stack(
            [0.5 * crank * along, right + 0.5 * crank * along, middle + crank * along], axis=1
        )

    return case_of(
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
    """A block slides down a slope on a carriage: three sliders, but one degree of freedom."""
    heavy, light = 3.0, 1.0
    place = (0.0, 0.0, 1.0)

    def exact(time: Array) -> Array:
        way = 0.5 * light * G / (heavy + 2.0 * light) * time[:, None] ** 2
        along = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0]])
        return np.array(place) + way[..., None] * along

    return case_of(
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

    return case_of(
        "welded",
        "a loop closed by a fixed joint, under a hinge torque",
        [even(names[k], 1.0 + k, moment, places[k]) for k in range(3)],
        exact,
        Joint("axle", "hinge", "world", "x", NONE, (0.0, 0.0, 1.0)),
        *(Joint(f"weld {k}", "fixed", names[k - 1], names[k], places[k]) for k in range(3)),
        torques=(Torque("axle", (torque,)),),
        gravity=NONE,
    )


def _vector(place: Array) -> Vector:
    x, y, z = place.tolist()
    return (x, y, z)


def _chain_of_balls() -> Case:
    """Different boxes thrown about their ball joints; the outer one turns by over half a turn."""
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
        # Parent and child are against the tree's direction.
        Joint("second", "ball", "outer", "middle", (0.7, 0.3, 0.3)),
        forces=(
            Force("inner", ((3.0, 0.0, 1.0),)),
            Force("middle", ((0.0, -4.0, 2.0),)),
            Force("outer", ((-2.0, 1.0, 0.0),)),
        ),
    )


def _ball_loop() -> Case:
    """Two bodies swing about the line of their hooks, and each about its own two balls."""
    return _referenced(
        "ball loop",
        "a loop in space closed by a ball at the world",
        [
            _brick("left", (0.2, 0.1, -0.3), spin=(3.2, 0.6, -1.5)),
            _brick("right", (0.6, -0.1, -0.4)),
        ],
        Joint("left hook", "ball", "world", "left", NONE),
        Joint("middle", "ball", "left", "right", (0.4, 0.2, -0.5)),
        Joint("right hook", "ball", "right", "world", (0.9, 0.0, 0.0)),
    )


def _hooke(*, divided: bool = False) -> Case:
    """Two shafts at an angle and a cross between them: four hinges through one point.

    The last bearing closes the loop and drives it. With a ball joint in its place, the second
    shaft would turn freely about the point. If that shaft is divided into two and all hinges have
    rotors, which keep them in the tree, the fixed joint between the halves closes the loop.
    """
    bend = 0.6
    out = (float(np.cos(bend)), 0.0, float(np.sin(bend)))
    across = (-out[2], 0.0, out[0])
    rotor = 0.02 if divided else 0.0
    half = [_brick("half", (0.5 * out[0], 0.05, 0.5 * out[2]))] if divided else []
    sleeve = Joint("sleeve", "fixed", "driving", "half", (0.4 * out[0], 0.0, 0.4 * out[2]))
    last = "half" if divided else "driving"
    return _referenced(
        "divided shaft" if divided else "Hooke's joint",
        "a loop in space closed by a fixed joint, as all its hinges have rotors"
        if divided
        else "a loop in space closed by a hinge at the world, which is driven",
        [
            _brick("driven", (-0.3, 0.1, 0.0)),
            _brick("cross", (0.0, 0.0, 0.05)),
            _brick("driving", (0.3 * out[0], -0.1, 0.3 * out[2])),
            *half,
        ],
        Joint(
            "bearing", "hinge", "world", "driven", NONE, (1.0, 0.0, 0.0), rate=4.0, armature=rotor
        ),
        Joint("yoke", "hinge", "driven", "cross", NONE, (0.0, 1.0, 0.0), armature=rotor),
        Joint("other yoke", "hinge", "cross", "driving", NONE, across, armature=rotor),
        Joint("other bearing", "hinge", last, "world", NONE, out, armature=rotor),
        *([sleeve] if divided else []),
        torques=(Torque("other bearing", (0.5,)),),
        length=0.6,
    )


def _linked() -> Case:
    """One body on a ball joint tows another that flies."""
    ends, points = ("hung", "thrown"), ((0.3, 0.1, -0.2), (0.6, 0.2, -0.3))
    return _referenced(
        "linked",
        "a distance link between points off the centres of mass",
        [
            _brick("hung", (0.2, 0.0, -0.2), spin=(0.0, 3.0, 1.0)),
            _brick("thrown", (0.7, 0.1, -0.4), velocity=(0.0, 1.5, 0.0)),
        ],
        Joint("hook", "ball", "world", "hung", NONE),
        distance_links=(DistanceLink("link", ends, points),),
    )


def _brick(
    name: str, at: Vector, velocity: Vector | None = None, spin: Vector | None = None
) -> Body:
    """Make a body whose principal axes of inertia are along no axis of its frame."""
    inertia = Inertia(1.0 + abs(at[0]), (0.03, 0.05, 0.04), (0.01, -0.004, 0.006))
    return Body(name, inertia=inertia, position=at, velocity=velocity, angular_velocity=spin)


def _referenced(
    name: str, verifies: str, bodies: Sequence[Body], *joints: Joint, **more: Any
) -> Case:
    """Make a case that is compared with the reference, known at the frames of the scene."""

    @functools.cache
    def solved() -> Trajectory:
        return reference.solve(case.scene, draw_batch(case.scene, [0]), cache=False)

    case = case_of(
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


LOOPS: tuple[Case, ...] = (
    _parallelogram(), _chain_of_balls(), _ball_loop(), _hooke(), _hooke(divided=True), _linked(),
    _wedge(), _welded(),
)  # fmt: skip
