"""Particles on a grid: who is whose neighbour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

Cell = tuple[int, int, int]
Point = tuple[float, float, float]
Edge = tuple[int, int]


def neighbours(cells: Sequence[Cell], *, apart: int = 1) -> list[Edge]:
    """Pairs of cells whose coordinates differ by `apart` in all, numbered as the cells are."""
    return [
        (a, b)
        for (a, here), (b, there) in combinations(enumerate(cells), 2)
        if sum(abs(p - q) for p, q in zip(here, there, strict=True)) == apart
    ]


def ties(hub: int, point: Point, body: Sequence[Point]) -> list[Edge]:
    """Edges from a hub to all the nearest of a body's particles, which are numbered from 0."""
    distances = [math.dist(point, particle) for particle in body]
    nearest = min(distances)
    return [(k, hub) for k, distance in enumerate(distances) if distance < nearest + 1e-9]
