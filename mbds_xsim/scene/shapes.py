"""What native listings share: balls and rods that show a mechanism, and the law of springs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PointPair

THICK, THIN = 0.02, 0.007
"""Radii of what has no size of its own, in lengths of the scene."""

TENSION = """

def pull(ends, points, length, stiffness, damping):
    (first, first_rate), (second, second_rate) = map(motion, ends, points)
    line = second - first
    along = line / np.linalg.norm(line)
    tension = stiffness * (np.linalg.norm(line) - length)
    tension += damping * along @ (second_rate - first_rate)
"""
"""The beginning of a listing's function that pulls at both ends of a spring; `motion` places one.
"""

Point = list[float]


@dataclass(frozen=True)
class Shape:
    """A ball around a point, or a rod between two points of a body."""

    body: int
    radius: float
    """[m]"""
    points: tuple[Point, ...]
    """One or two, in the body's native frame [m]."""


def shapes(mechanism: Mechanism) -> Iterator[Shape]:
    """Give balls for particles, centres of mass and contact spheres, rods from these to joints."""
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
    """Write a listing's call of `pull`.

    Args:
        spring: Which.
        end: Writes a body.
        points: The ends, in the frames in which the listing's `motion` takes them.
    """
    ends = ", ".join("None" if body == WORLD_INDEX else end(body) for body in spring.bodies)
    places = ", ".join(repr(point.tolist()) for point in points)
    law = f"{spring.length!r}, {spring.stiffness!r}, {spring.damping!r}"
    return f"    pull(({ends}), ({places}), {law})"
