"""Collision shapes as contact spheres: what of a shape a plane can meet."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from mbds_xsim.base.arrays import Array

SHARE = 0.1
"""Radius of the spheres in edges of a shape, over its smallest half-size."""
RIM = 8
"""Spheres in each rim of a cylinder, as many as PyBullet has room for on a body; half-way between
two they lack 7.6 % of its radius."""


@dataclass(frozen=True, eq=False)
class Balls:
    """Spheres of one radius inside a shape, in its frame."""

    centers: Array
    """[m], shape (sphere, 3)."""
    radius: float
    """[m]"""
    short: float = 0.0
    """By how much a plane may be nearer to the shape than to the nearest of them, at most [m]."""
    how: str = ""
    """In words."""


def _sphere(size: Array) -> Balls:
    return Balls(np.zeros((1, 3)), float(size[0]), how="a contact sphere")


def _capsule(size: Array) -> Balls:
    ends = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
    return Balls(ends, float(size[0]), how="the spheres of its ends, which meet a plane as it does")


def _box(size: Array) -> Balls:
    # In a corner they lack r (|n|₁ − 1) along n, from nothing on a face to most on the diagonal.
    radius = SHARE * float(size.min())
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * (size - radius)
    how = "eight spheres in its corners, which touch its faces; it lacks at most what is said"
    return Balls(corners, radius, (math.sqrt(3.0) - 1.0) * radius, how)


def _cylinder(size: Array) -> Balls:
    radius = SHARE * float(size[:2].min())
    ring, height = size[:2] - radius
    angles = 2.0 * np.pi / RIM * np.arange(RIM)
    rim = ring * np.column_stack([np.cos(angles), np.sin(angles)])
    centers = [np.column_stack([rim, np.full(RIM, z)]) for z in (-height, height)]
    short = ring * (1.0 - math.cos(math.pi / RIM)) + (math.sqrt(2.0) - 1.0) * radius
    how = f"{RIM} spheres in each rim, exact on its ends; it lacks at most what is said"
    return Balls(np.concatenate(centers), radius, float(short), how)


BALLS: Mapping[str, Callable[[Array], Balls]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "cylinder": _cylinder,
}
"""By kind, of half-sizes: the radius; the radius and half the length along z; along x, y and z."""
