"""The model as a program that runs to the end: shapes, start, springs, steps, and what came of it.

Put after the listing of `_dart_listing`, whose names it uses.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.mechanism import WORLD_INDEX, Mechanism, PointPair
from mbds_xsim.shapes import shapes

__all__ = ["script"]

Array = NDArray[np.float64]

_SHAPES = """

def show(body, radius, *points):
    shape = dart.dynamics.MultiSphereConvexHullShape([(radius, point) for point in points])
    bodies[body].createShapeNode(shape).createVisualAspect()

"""
_SPRINGS = """

def motion(body, point):
    if body is None:
        return np.array(point), np.zeros(3)
    place = body.getWorldTransform()
    return place.translation() + place.rotation() @ point, body.getLinearVelocity(point)


def pull(ends, points, length, stiffness, damping):
    (first, first_rate), (second, second_rate) = map(motion, ends, points)
    line = second - first
    along = line / np.linalg.norm(line)
    tension = stiffness * (np.linalg.norm(line) - length)
    tension += damping * along @ (second_rate - first_rate)
    for end, point, sign in zip(ends, points, (1.0, -1.0)):
        if end is not None:
            end.addExtForce(sign * tension * along, point)


def load():
    skeleton.clearExternalForces()"""
_VIEW = """
# To watch it: viewer = dart.gui.osg.Viewer()
# viewer.addWorldNode(dart.gui.osg.RealTimeWorldNode(world)); viewer.run()"""
_RESULT = """
for body in sorted(bodies):  # centre of mass, rotation matrix, velocity, angular velocity
    place = bodies[body].getWorldTransform()
    rates = bodies[body].getCOMLinearVelocity(), bodies[body].getAngularVelocity()
    print(body, *(part.tolist() for part in (place.translation(), place.rotation(), *rates)))
"""


def script(mechanism: Mechanism, q: Array, u: Array, step: str, count: int) -> str:
    """Write what follows on the listing.

    Args:
        mechanism: The scene's.
        q: Generalised coordinates at the start.
        u: Generalised velocities at the start.
        step: The call of a step; empty where the engine has none.
        count: Steps.
    """
    return "\n".join(_statements(mechanism, q, u, step, count))


def _statements(mechanism: Mechanism, q: Array, u: Array, step: str, count: int) -> Iterator[str]:
    yield _SHAPES.rstrip("\n") + "\n\n"
    for shape in shapes(mechanism):
        points = ", ".join(map(repr, shape.points))
        yield f"show({shape.body}, {shape.radius!r}, {points})"
    yield f"skeleton.setPositions({q.tolist()!r})"
    yield f"skeleton.setVelocities({u.tolist()!r})"
    if mechanism.springs:
        yield _SPRINGS
        yield from map(_pull, mechanism.springs)
        yield "\n"
    yield _VIEW
    if step:
        yield f"for _ in range({count}):"
        yield from ["    load()"] if mechanism.springs else []
        yield f"    {step}"
    else:
        yield "# The steps are the toolkit's: RK4 on skeleton.computeForwardDynamics()."
    yield _RESULT


def _pull(spring: PointPair) -> str:
    ends = ", ".join("None" if k == WORLD_INDEX else f"bodies[{k}]" for k in spring.bodies)
    points = ", ".join(repr(point.tolist()) for point in spring.in_body)
    law = f"{spring.length!r}, {spring.stiffness!r}, {spring.damping!r}"
    return f"    pull(({ends}), ({points}), {law})"
