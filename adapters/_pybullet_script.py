"""The end of a listing: springs, steps, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism, PointPair

__all__ = ["script"]

Array = NDArray[np.float64]
Address = Callable[[int], tuple[int, int]]

_SPRINGS = """
import numpy as np


def motion(address, point):
    if address is None:
        return np.array(point), np.zeros(3)
    if address[1] == -1:
        state = p.getBasePositionAndOrientation(address[0]) + p.getBaseVelocity(address[0])
    else:
        state = [p.getLinkState(*address, 1, 1)[k] for k in (0, 1, 6, 7)]
    arm = np.reshape(p.getMatrixFromQuaternion(state[1]), (3, 3)) @ point
    return state[0] + arm, state[2] + np.cross(state[3], arm)


def pull(ends, points, length, stiffness, damping):
    (first, first_rate), (second, second_rate) = map(motion, ends, points)
    line = second - first
    along = line / np.linalg.norm(line)
    tension = stiffness * (np.linalg.norm(line) - length)
    tension += damping * along @ (second_rate - first_rate)
    for end, place, sign in zip(ends, (first, second), (1, -1)):
        if end is not None:
            p.applyExternalForce(*end, list(sign * tension * along), list(place), p.WORLD_FRAME)

"""
_RESULT = """\
for body in range(p.getNumBodies()):
    print(body, "base", p.getBasePositionAndOrientation(body), p.getBaseVelocity(body))
    for link in range(p.getNumJoints(body)):
        position, turn, *_, velocity, rate = p.getLinkState(body, link, 1, 1)
        print(body, link, position, turn, velocity, rate)
"""


def script(mechanism: Mechanism, principal: Array, address: Address, count: int) -> str:
    """Write the end of a script.

    Args:
        mechanism: The scene's.
        principal: From principal axes, in which Bullet has bodies, to native frames, (body, 4).
        address: Of a body in Bullet.
        count: Calls of the engine's step.
    """
    pulls = [_pull(spring, principal, address) for spring in mechanism.springs]
    springs = [_SPRINGS] if pulls else [""]
    loop = [f"for _ in range({count}):", *pulls, "    p.stepSimulation()"]
    return "\n".join([*springs, *loop, _RESULT])


def _pull(spring: PointPair, principal: Array, address: Address) -> str:
    ends = ", ".join(
        "None" if body == WORLD_INDEX else repr(address(body)) for body in spring.bodies
    )
    points = ", ".join(repr(point.tolist()) for point in _points(spring, principal))
    law = f"{spring.length!r}, {spring.stiffness!r}, {spring.damping!r}"
    return f"    pull(({ends}), ({points}), {law})"


def _points(spring: PointPair, principal: Array) -> Iterator[Array]:
    for body, point in zip(spring.bodies, spring.in_body, strict=True):
        axes = rotation.IDENTITY if body == WORLD_INDEX else principal[body]
        yield rotation.rotate(rotation.conjugate(axes), point)
