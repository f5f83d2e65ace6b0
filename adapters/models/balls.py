"""Contact spheres that stand for a collision shape where it meets a plane."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from mbds_xsim.base.arrays import Array

SHARE = 0.1
"""Radius of the spheres in corners and rims of a shape, over its smallest half-size."""
RIM = 8
"""Number of spheres in each rim of a cylinder. Half-way between two of them, up to 7.6 % of the
cylinder's radius is missing."""


@dataclass(frozen=True, eq=False)
class Balls:
    """Spheres of equal radius inside a shape."""

    centers: Array
    """Centres in the shape's frame [m], shape (sphere, 3)."""
    radius: float
    """[m]"""
    short: float = 0.0
    """Largest amount by which a plane can be nearer to the shape than to the spheres [m]."""
    how: str = ""
    """Description for the report."""


def _sphere(size: Array) -> Balls:
    return Balls(np.zeros((1, 3)), float(size[0]), how="a contact sphere")


def _capsule(size: Array) -> Balls:
    ends = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
    return Balls(ends, float(size[0]), how="the spheres of its ends, which meet a plane as it does")


def _box(size: Array) -> Balls:
    # Along n, a corner's sphere falls short by r (|n|₁ − 1): 0 on a face, most on the diagonal.
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
"""Spheres by kind of shape, from half-sizes: radius; radius and half-length along z; x, y and z."""
