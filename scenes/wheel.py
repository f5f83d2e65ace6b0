"""A wheel: a hub particle and a ring of twelve around it."""

from __future__ import annotations

import math

import numpy as np

from mbds_xsim.scene.scene import Body, Particle

from .grid import Edge, Point

RING = 12
PARTICLES = RING + 1


def wheel(name: str, hub: Point, axis: Point, first: Point, radius: float) -> Body:
    """Make the body: its hub, then its ring from the direction `first` on, turning about `axis`.

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


def wheel_edges(hub: int) -> list[Edge]:
    """Spokes and ring of the wheel whose hub has this number."""
    ring = range(hub + 1, hub + PARTICLES)
    return [
        *((hub, k) for k in ring),
        *((k, hub + 1 + (k - hub) % RING) for k in ring),
    ]
