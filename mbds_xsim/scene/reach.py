"""How far a mechanism reaches, to notice a `length` in another unit."""

from __future__ import annotations

import math

import numpy as np

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene

_DOUBTFUL = 30.0
"""Least factor between length and reach that is doubted; the built-in scenes have at most 8."""


def _reach(mechanism: Mechanism) -> float:
    """Return the extent of all points of the mechanism, or the size of its largest body [m].

    Points are centres of mass, joints, ends of links and springs, and spheres, at the reference.
    """
    scene = mechanism.scene
    pairs = (*scene.distance_links, *scene.springs)
    points = [*mechanism.com, *(joint.anchor for joint in mechanism.joints)]
    points += (np.array(point) for pair in pairs for point in pair.points)
    for sphere in scene.contacts:
        points += (np.array(sphere.center) + sign * sphere.radius for sign in (-1.0, 1.0))
    moments = np.trace(mechanism.inertia, axis1=1, axis2=2)
    size = math.sqrt(float((moments / mechanism.mass).max()))
    return max(math.hypot(*np.ptp(points, axis=0)), size)


def doubted_length(scene: Scene) -> str:
    """Return a warning of a length that is far from the mechanism's reach; "" if it is not."""
    actual = _reach(Mechanism.of(scene))
    if not actual or 1.0 / _DOUBTFUL < (times := scene.length / actual) < _DOUBTFUL:
        return ""
    factor = f"{times:.0f}" if times > 1.0 else f"{times:.2g}"
    return (
        f"{scene.name}: its length of {scene.length:g} m is {factor} times the "
        f"mechanism's reach ({actual:.2g} m); errors are judged by it"
    )
