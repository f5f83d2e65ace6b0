"""Common parts of native listings: balls and rods that show a mechanism, and the spring law."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PointPair

THICK, THIN = 0.02, 0.007
"""Radii of balls and rods that have no size of their own, relative to the scene's length."""

TENSION = """

def pull(ends, points, length, stiffness, damping):
    (first, first_rate), (second, second_rate) = map(motion, ends, points)
    line = second - first
    along = line / np.linalg.norm(line)
    tension = stiffness * (np.linalg.norm(line) - length)
    tension += damping * along @ (second_rate - first_rate)
"""
"""Beginning of a listing's function that pulls at both ends of a spring; `motion` places an end."""

Point = list[float]


@dataclass(frozen=True)
class Shape:
    """A ball around a point, or a rod between two points of a body."""

    body: int
    radius: float
    """Radius [m]."""
    points: tuple[Point, ...]
    """One or two points in the body's native frame [m]."""


def shapes(mechanism: Mechanism) -> Iterator[Shape]:
    """Yield balls for particles, centres of mass and spheres, and rods from centres to joints."""
    length = mechanism.scene.length
    for body, place in zip(mechanism.particle_body, mechanism.particle_offset, strict=True):
        yield Shape(int(body), THICK * length, (place.tolist(),))
    for body, count in enumerate(mechanism.particles_per_body):
        if not count:
            yield Shape(body, THICK * length, ([0.0, 0.0, 0.0],))
    for body, place, radius in zip(
        mechanism.sphere_body, mechanism.sphere_offset, mechanism.sphere_radius, strict=True
    ):
        yield Shape(int(body), float(radius), (place.tolist(),))
    pairs = (*mechanism.distances, *mechanism.springs)
    ends = [(j.parent, j.in_parent) for j in mechanism.joints]
    ends += [(j.child, j.in_child) for j in mechanism.joints]
    ends += [end for pair in pairs for end in zip(pair.bodies, pair.in_body, strict=True)]
    for body, place in ends:
        if body != WORLD_INDEX and np.any(place):
            yield Shape(body, THIN * length, ([0.0, 0.0, 0.0], place.tolist()))


def pull_call(spring: PointPair, end: Callable[[int], str], points: Iterable[Array]) -> str:
    """Write a listing's call to `pull`.

    Args:
        spring: Spring that pulls.
        end: Function that writes a body.
        points: Ends of the spring, in the frames that the listing's `motion` expects.
    """
    ends = ", ".join("None" if body == WORLD_INDEX else end(body) for body in spring.bodies)
    places = ", ".join(repr(point.tolist()) for point in points)
    law = f"{spring.length!r}, {spring.stiffness!r}, {spring.damping!r}"
    return f"    pull(({ends}), ({places}), {law})"
