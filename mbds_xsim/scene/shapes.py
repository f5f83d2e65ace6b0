"""Balls and rods that show a mechanism in an engine's own window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism

THICK, THIN = 0.02, 0.007
"""Radii of what has no size of its own, in lengths of the scene."""

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
