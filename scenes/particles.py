"""Bodies of particles: grids, wheels, and the edges between neighbours."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np

from mbds_xsim.scene.scene import Body, Particle

Cell = tuple[int, int, int]
Point = tuple[float, float, float]
Edge = tuple[int, int]

RING = 12


def neighbours(cells: Sequence[Cell], *, apart: int = 1) -> list[Edge]:
    """Return pairs of cells whose coordinates differ by `apart` in total, as cell numbers."""
    return [
        (a, b)
        for (a, here), (b, there) in combinations(enumerate(cells), 2)
        if sum(abs(p - q) for p, q in zip(here, there, strict=True)) == apart
    ]


def wheel(name: str, hub: Point, axis: Point, first: Point, radius: float) -> Body:
    """Make a wheel's body: its hub, then its ring from the direction `first` on, about `axis`.

    Both directions are unit and normal to each other; `radius` is that of the ring's centres [m].
    """
    second = np.cross(axis, first)
    points = [hub]
    for k in range(RING):
        angle = 2.0 * math.pi * k / RING
        arm = radius * (math.cos(angle) * np.array(first) + math.sin(angle) * second)
        x, y, z = (np.array(hub) + arm).tolist()
        points.append((x, y, z))
    return Body(name, particles=tuple(map(Particle, points)))


def wheel_edges(hubs: Iterable[Point], body: Sequence[Point]) -> list[Edge]:
    """Return the edges of wheels whose particles are numbered after those of a body.

    Each has spokes, a ring, and edges from its hub to all the nearest of the body's particles.
    """
    edges: list[Edge] = []
    for number, point in enumerate(hubs):
        hub = len(body) + number * (1 + RING)
        ring = range(hub + 1, hub + 1 + RING)
        edges += [(hub, k) for k in ring]
        edges += [(k, hub + 1 + (k - hub) % RING) for k in ring]
        distances = [math.dist(point, particle) for particle in body]
        reach = min(distances) + 1e-9
        edges += [(k, hub) for k, distance in enumerate(distances) if distance < reach]
    return edges
