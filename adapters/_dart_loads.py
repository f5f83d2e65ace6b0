"""What acts on the bodies: input forces and torques held over a frame, spring–dampers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.mechanism import WORLD_INDEX, PointPair

from ._dart_model import Model

__all__ = ["Loads"]

Array = NDArray[np.float64]


class Loads:
    """Applies the loads of a frame.

    DART keeps external forces in the axes of the body they act on, so a force that is constant in
    W is set again at every configuration; joint torques stay as set. Loop hinges have no joint to
    drive: they get opposite external torques about the axis fixed in either body.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._springs = [_Spring(pair, model.bodies) for pair in model.mechanism.springs]
        self._pulled = {k for spring in self._springs for k in spring.moving}
        self.forces: list[tuple[Callable[[Array], None], Array]] = []
        """What to call first in each step, with which force [N]."""
        self.others: list[Callable[[], None]] = []
        """What to call then."""
        loops = {joint.index for joint in model.mechanism.loops}
        hinges = list(enumerate(model.mechanism.hinges))
        carried = {link.joint.index: link.body for link in model.mechanism.links if link.joint}
        self._driven = [
            (k, model.joints[carried[hinge.index]])
            for k, hinge in hinges
            if hinge.index not in loops
        ]
        self._looped = [(k, hinge) for k, hinge in hinges if hinge.index in loops]

    def hold(self, force: Array, torque: Array) -> None:
        """Take the inputs of a frame: forces in W (body, 3) [N], hinge torques (hinge,) [N·m]."""
        bodies = self._model.bodies
        for k, joint in self._driven:
            joint.setForce(0, torque[k])
        twist = self._twist(torque)
        pushed = {*np.flatnonzero(force.any(axis=-1)).tolist(), *twist, *self._pulled}
        self._model.skeleton.clearExternalForces()
        self.forces = [(bodies[k].setExtForce, force[k]) for k in sorted(pushed)]
        self.others = [partial(bodies[k].addExtTorque, twist[k], True) for k in sorted(twist)]
        self.others += [spring.pull for spring in self._springs]

    def _twist(self, torque: Array) -> dict[int, Array]:
        """Torques of the driven loop hinges, by body and in its native frame [N·m]."""
        twist: dict[int, Array] = {}
        for k, hinge in self._looped:
            for body, sign in ((hinge.child, 1.0), (hinge.parent, -1.0)):
                if body != WORLD_INDEX and torque[k]:
                    twist[body] = twist.get(body, 0.0) + sign * torque[k] * hinge.axis
        return twist

    def springs(self) -> Array:
        """Give what `Readback.spring` tells, in the present configuration."""
        return np.array([spring.told() for spring in self._springs]).reshape(-1, 4)

    def apply(self) -> None:
        """Set the external forces for the present configuration."""
        for push, force in self.forces:
            push(force)
        for act in self.others:
            act()


class _Spring:
    """A spring–damper between two bodies, or a body and the world."""

    def __init__(self, pair: PointPair, bodies: list[Any]) -> None:
        self._pair = pair
        self._ends = [None if k == WORLD_INDEX else bodies[k] for k in pair.bodies]
        self.moving = [k for k in pair.bodies if k != WORLD_INDEX]

    def told(self) -> tuple[float, float, float, float]:
        """Give stiffness, damping, rest length and present length."""
        pair = self._pair
        return pair.stiffness, pair.damping, pair.length, float(np.linalg.norm(self._line()[0]))

    def _line(self) -> tuple[Array, Array]:
        """From the first end to the second in W [m], and its rate [m/s]."""
        (first, first_rate), (second, second_rate) = (
            _motion(end, point) for end, point in zip(self._ends, self._pair.in_body, strict=True)
        )
        return second - first, second_rate - first_rate

    def pull(self) -> None:
        """Add the force at the present configuration and velocity."""
        pair = self._pair
        line, rate = self._line()
        length = float(np.linalg.norm(line))
        along = line / length
        tension = pair.stiffness * (length - pair.length)
        tension += pair.damping * float(along @ rate)
        for end, point, sign in zip(self._ends, pair.in_body, (1.0, -1.0), strict=True):
            if end is not None:
                end.addExtForce(sign * tension * along, point)


def _motion(body: Any, point: Array) -> tuple[Array, Array]:
    """Position and velocity in W of a point given in the native frame (W for the world)."""
    if body is None:
        return point, np.zeros(3)
    place = body.getWorldTransform()
    return place.translation() + place.rotation() @ point, body.getLinearVelocity(point)
