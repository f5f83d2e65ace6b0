"""Loads on the bodies of a DART model, and the methods that step it over a frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import WORLD_INDEX, PointPair
from mbds_xsim.scene.servo import PlacedDrive
from mbds_xsim.simulate.turning_rk4 import TurningRK4

from .model import SkeletonModel
from .stops import ImplicitStops

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
# Below this, sin(x)/x is 1; squares of smaller numbers vanish.
_TINY = 1e-150


class FrameLoads:
    """Loads of a frame, applied in each of its steps.

    DART keeps external forces in the axes of the body they act on, so a force that is constant in
    W is set again at every configuration; joint torques stay as set. Loop hinges have no joint to
    drive: they get opposite external torques about the axis fixed in either body.
    """

    def __init__(self, model: SkeletonModel, step: float) -> None:
        self._model = model
        self._springs = [_Spring(pair, model.bodies) for pair in model.mechanism.springs]
        self._spring_bodies = {k for spring in self._springs for k in spring.moving}
        self.forces: list[tuple[Callable[[Array], None], Array]] = []
        """First calls of each step, each with its force in W [N]."""
        self.others: list[Callable[[], None]] = []
        """Further calls of each step."""
        loops = {joint.index for joint in model.mechanism.loops}
        hinges = list(enumerate(model.mechanism.hinges))
        carried = model.mechanism.carried
        self._driven = [
            (k, model.joints[carried[hinge.index]])
            for k, hinge in hinges
            if hinge.index not in loops
        ]
        self._looped = [(k, hinge) for k, hinge in hinges if hinge.index in loops]
        drives = defaultdict[int, list[tuple[int, PlacedDrive]]](list)
        for k, drive in enumerate(model.mechanism.drives, len(hinges)):
            drives[drive.joint.index].append((k, drive))
        joints = {joint.index: joint for joint in model.mechanism.joints if joint.driven}
        joints |= {joint.index: joint for joint in model.mechanism.rotors}
        self._actuated = [
            (model.joints[carried[k]], joint, drives[k], joint.armature / step)
            for k, joint in joints.items()
        ]
        self.stops = ImplicitStops(model, step)

    def hold(self, force: Array, torque: Array) -> None:
        """Set the inputs of a frame.

        Args:
            force: Forces in W, shape (body, 3) [N].
            torque: Hinge torques, then pushes of drives, shape (hinge + drive,) [N·m or N].
        """
        bodies = self._model.bodies
        for k, joint in self._driven:
            joint.setForce(0, torque[k])
        twist = self._twist(torque)
        pushed = {*np.flatnonzero(force.any(axis=-1)).tolist(), *twist, *self._spring_bodies}
        self._model.skeleton.clearExternalForces()
        self.forces = [(bodies[k].setExtForce, force[k]) for k in sorted(pushed)]
        self.others = [partial(bodies[k].addExtTorque, twist[k], True) for k in sorted(twist)]
        self.others += [spring.pull for spring in self._springs]
        for joint, placed, servos, damping in self._actuated:
            is_hinge = placed in self._model.mechanism.hinges
            load = joint.getForce(0) if is_hinge else 0.0  # a hinge's input was set just above
            laws = [partial(servo.at, float(torque[k])) for k, servo in servos]
            self.others.append(partial(_lead, joint, laws, damping, load))
        if self.stops.all:
            self.others.append(self.stops.hold)

    def _twist(self, torque: Array) -> dict[int, Array]:
        """Return the torques of driven loop hinges, by body and in its native frame [N·m]."""
        twist: dict[int, Array] = {}
        for k, hinge in self._looped:
            for body, sign in ((hinge.child, 1.0), (hinge.parent, -1.0)):
                if body != WORLD_INDEX and torque[k]:
                    twist[body] = twist.get(body, 0.0) + sign * torque[k] * hinge.axis
        return twist

    def springs(self) -> Array:
        """Return `Readback.spring` in the present configuration."""
        return np.array([spring.as_read() for spring in self._springs]).reshape(-1, 4)

    def apply(self) -> None:
        """Set the external forces for the present configuration."""
        for push, force in self.forces:
            push(force)
        for act in self.others:
            act()


def _lead(
    joint: Any, laws: Sequence[Callable[[float, float], float]], damping: float, load: float
) -> None:
    """Set a joint's force: its load, plus its servos' efforts at the present state.

    Also undo the torque of the damper that represents a rotor.
    """
    place, rate = joint.getPosition(0), joint.getVelocity(0)
    effort = sum(law(place, rate) for law in laws)
    joint.setForce(0, load + effort + damping * rate)


class _Spring:
    """A spring–damper between two bodies, or a body and the world."""

    def __init__(self, pair: PointPair, bodies: list[Any]) -> None:
        self._pair = pair
        self._ends = [None if k == WORLD_INDEX else bodies[k] for k in pair.bodies]
        self.moving = [k for k in pair.bodies if k != WORLD_INDEX]

    def as_read(self) -> tuple[float, float, float, float]:
        """Return this spring's row of `Readback.spring`."""
        return self._pair.as_read(self._line()[0])

    def _line(self) -> tuple[Array, Array]:
        """Return the line from the first end to the second in W [m], and its rate [m/s]."""
        (first, first_rate), (second, second_rate) = (
            _motion(end, point) for end, point in zip(self._ends, self._pair.in_body, strict=True)
        )
        return second - first, second_rate - first_rate

    def pull(self) -> None:
        """Add the force at the present configuration and velocity."""
        force = self._pair.pull(*self._line())
        for end, point, pull in zip(self._ends, self._pair.in_body, (force, -force), strict=True):
            if end is not None:
                end.addExtForce(pull, point)


def _motion(body: Any, point: Array) -> tuple[Array, Array]:
    """Return position and velocity in W of a point of the native frame (of W for the world)."""
    if body is None:
        return point, np.zeros(3)
    place = body.getWorldTransform()
    return place.translation() + place.rotation() @ point, body.getLinearVelocity(point)


class DartStepper(ABC):
    """A method that steps the skeleton from its present state."""

    call: ClassVar[str]
    """The engine's call for one step; empty if it has none."""

    def __init__(self, model: SkeletonModel, loads: FrameLoads, step: float) -> None:
        self.model = model
        self.loads = loads
        self.step = step

    @abstractmethod
    def advance(self, step_count: int) -> None:
        """Take `step_count` steps under the held loads."""


class SemiImplicitEuler(DartStepper):
    """DART's own `World.step`: velocities first, constraint impulses, then positions."""

    call = "world.step(False)"

    def advance(self, step_count: int) -> None:
        step, loads = self.model.world.step, self.loads
        for _ in range(step_count):
            # `FrameLoads.apply`, inlined: a call in each step would take noticeable time.
            for push, force in loads.forces:
                push(force)
            for act in loads.others:
                act()
            step(False)


class ForwardDynamicsRK4(DartStepper):
    """The toolkit's `TurningRK4` on DART's `computeForwardDynamics`.

    Within a step, DART's `integratePositions` applies the increments.
    """

    call = ""

    def __init__(self, model: SkeletonModel, loads: FrameLoads, step: float) -> None:
        super().__init__(model, loads, step)
        # Springs and dampers of joints are implicit over the skeleton's own step.
        model.skeleton.setTimeStep(_TINY)
        self._armature = model.armature()
        self._rk4 = TurningRK4(model.coordinate_count, model.turning_at, model.side)

    def advance(self, step_count: int) -> None:
        skeleton = self.model.skeleton
        q, u = skeleton.getPositions(), skeleton.getVelocities()
        for _ in range(step_count):
            q, u = self._rk4.step(self.step, q, u, self._acceleration, self._moved)
        self.model.set_state(q, u)

    def _acceleration(self, q: Array, increment: Array, u: Array) -> Array:
        skeleton = self.model.skeleton
        self.model.set_state(q, increment)
        skeleton.integratePositions(1.0)
        skeleton.setVelocities(u)
        self.loads.apply()
        skeleton.computeForwardDynamics()
        acceleration = skeleton.getAccelerations()
        if self._armature.any():
            mass = skeleton.getMassMatrix()
            acceleration = np.linalg.solve(mass + self._armature, mass @ acceleration)
        return acceleration

    def _moved(self, q: Array, increment: Array) -> Array:
        """Return q moved by an increment, exactly; DART truncates its series below 1e-3 rad."""
        moved = q + increment
        turns = self.model.turning_at
        moved[turns] = _compose(q[turns], increment[turns], self.model.side)
        return moved


def _compose(q: Array, increment: Array, side: Array) -> Array:
    """Return rotation vectors of exp(q)·exp(increment), or exp(increment)·exp(q) if side is −1.

    Written out because it runs in every step; shapes (rotation, 3) and (rotation,).
    """
    count = len(q)
    half = 0.5 * np.concatenate([q, increment])
    angle = np.sqrt(np.einsum("ij,ij->i", half, half))
    half *= (np.sin(angle) / np.maximum(angle, _TINY) + (angle < _TINY))[:, None]
    cosine = np.cos(angle)
    a, b, cos_a, cos_b = half[:count], half[count:], cosine[:count], cosine[count:]
    w = cos_a * cos_b - np.einsum("ij,ij->i", a, b)
    v = cos_a[:, None] * b + cos_b[:, None] * a
    v += side[:, None] * (a[:, _NEXT] * b[:, _AFTER] - a[:, _AFTER] * b[:, _NEXT])
    sine = np.sqrt(np.einsum("ij,ij->i", v, v))
    # Of the quaternions (w, v) and (−w, −v), the one with w ≥ 0 turns by at most π.
    turn = 2.0 * np.copysign(np.arctan2(sine, np.abs(w)), w)
    return v * (turn / np.maximum(sine, _TINY) + 2.0 * (sine < _TINY))[:, None]


STEPPERS: Mapping[str, type[DartStepper]] = {
    "semi-implicit-euler": SemiImplicitEuler,
    "forward-dynamics-RK4": ForwardDynamicsRK4,
}
"""Steppers by the name of their method."""
