"""Accelerations of a Pinocchio model under springs and held loads, many states at a time.

The module needs only Pinocchio and numpy, because scripts shown to users contain its source.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import PointPair

End = tuple[int, Array]
"""A body, or −1 for the world, and a point of its frame [m]."""

_ACCURACY, _ROUNDS = 1e-12, 10


class PinocchioDynamics:
    """Accelerations of a model under loads that can be set.

    Args:
        model: Pinocchio's model.
        bodies: Frames of the bodies, at their centres of mass.
        constraints: Constraints that close the loops.
        springs: Springs between points of bodies.
        ends: Ends of each spring.
        laws: Laws of joint springs and dampers, and of servos: place among the coordinates and the
            velocities, stiffness, damping, coordinate at rest and limit, shape (law, 6).
        softness: Softness of the proximal steps that solve the constraints.
    """

    def __init__(
        self,
        model: pin.Model,
        bodies: Sequence[int],
        constraints: Sequence[pin.RigidConstraintModel],
        springs: Sequence[PointPair],
        ends: Sequence[Sequence[End]],
        laws: Array,
        softness: float,
    ) -> None:
        self.model, self.data = model, model.createData()
        self._constraints = pin.StdVec_RigidConstraintModel()
        self._closures = pin.StdVec_RigidConstraintData()
        for constraint in constraints:
            self._constraints.append(constraint)
            self._closures.append(constraint.createData())
        if constraints:
            pin.initConstraintDynamics(model, self.data, self._constraints, self._closures)
        yielding = float(np.mean([1.0 / model.frames[k].inertia.mass for k in bodies]))
        self._proximal = pin.ProximalSettings(_ACCURACY, _ACCURACY, softness * yielding, _ROUNDS)
        self._pool = pin.ModelPool(model, 1)
        self._springs = list(zip(springs, ends, strict=True))
        self._place, self._speed = laws[:, 0].astype(int), laws[:, 1].astype(int)
        self._stiffness, self._damping, self._rest, self._limit = laws[:, 2:].T
        self._onto = np.equal.outer(self._speed, np.arange(model.nv)).astype(float)
        self._frames = list(bodies)
        joints = [model.frames[k].parentJoint for k in self._frames]
        moving = [joint for joint in range(model.njoints) for _ in range(model.nvs[joint])]
        supports = [set(model.supports[joint]) for joint in joints]
        carries = [[float(j in below) for below in supports] for j in moving]
        self._carries = np.array(carries).reshape(model.nv, len(supports))
        self.torque: Array | float = 0.0
        """Held loads on the velocity coordinates, shape (state, coordinate)."""
        self.push: Array | float = 0.0
        """Pushes of the servos' targets, shape (law,); 0 for springs."""
        self.force: Array | None = None
        """Forces in W on the bodies' frames [N], shape (state, body, 3)."""
        self.turning: Array | None = None
        """Torques in the axes of the bodies' frames [N·m], shape (state, body, 3)."""

    def rate(self, q: Array, increment: Array, u: Array) -> Array:
        """Return the accelerations of states moved by an increment, (state, coordinate)."""
        return self.accelerations(self.moved(q, increment) if increment.any() else q, u)

    def moved(self, q: Array, increment: Array) -> Array:
        """Return each state moved by its increment."""
        model = self.model
        return np.array([pin.integrate(model, *pair) for pair in zip(q, increment, strict=True)])

    def accelerations(self, q: Array, u: Array) -> Array:
        """Return the accelerations of states, (state, coordinate)."""
        load = np.zeros_like(u) + self.torque
        if len(self._place):
            stretch = q[:, self._place] - self._rest
            pull = self._stiffness * stretch + self._damping * u[:, self._speed]
            load += np.clip(self.push - pull, -self._limit, self._limit) @ self._onto
        if self.force is not None or self.turning is not None or self._springs:
            for row in range(len(q)):
                load[row] += self._load_forces(row, q[row], u[row])
        rates = np.empty_like(u)
        if not len(self._constraints):
            pin.abaInParallel(1, self._pool, q.T, u.T, load.T, rates.T)
            return rates
        closed = self._constraints, self._closures, self._proximal
        for row in range(len(q)):
            state = q[row], u[row], load[row]
            rates[row] = pin.constraintDynamics(self.model, self.data, *state, *closed)
        return rates

    def _load_forces(self, row: int, q: Array, u: Array) -> Array:
        """Return the generalised forces from forces, torques and springs, (coordinate,)."""
        model, data = self.model, self.data
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        load = np.zeros((len(self._frames), 6))  # force, and moment about the world's origin
        if self.force is not None:
            load[:, :3] = self.force[row]
            load[:, 3:] = _cross(np.array([data.oMf[k].translation for k in self._frames]), load)
        if self.turning is not None:
            for body in np.flatnonzero(self.turning[row].any(axis=1)):
                turn = data.oMf[self._frames[body]].rotation
                load[body, 3:] += turn @ self.turning[row, body]
        # Each coordinate moves the bodies it carries along its column; a single column is flat.
        columns = data.J.reshape(6, -1)
        if self._springs:
            self._pull(load, columns * u)
        return np.einsum("ik,ki->k", columns, self._carries @ load)

    def _pull(self, load: Array, twists: Array) -> None:
        """Add the springs' loads on bodies, given the twist that each coordinate's rate causes."""
        for spring, ends in self._springs:
            places, speeds = [], []
            for body, point in ends:
                if body < 0:
                    places.append(point)
                    speeds.append(np.zeros(3))
                    continue
                places.append(self.data.oMf[self._frames[body]].act(point))
                twist = twists @ self._carries[:, body]
                speeds.append(twist[:3] + _cross(twist[None, 3:], places[-1][None])[0])
            force = spring.pull(places[1] - places[0], speeds[1] - speeds[0])
            for (body, _), place, pull in zip(ends, places, (force, -force), strict=True):
                if body >= 0:
                    load[body, :3] += pull
                    load[body, 3:] += _cross(place[None], pull[None])[0]


def _cross(a: Array, b: Array) -> Array:
    """Return a × b of the first three columns; much faster than numpy's on a few rows."""
    x, y, z = a.T
    u, v, w = b.T[:3]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
