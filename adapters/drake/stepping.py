"""Steps of a Drake system, with ball joints kept off the pitch where they are singular.

It needs nothing but Drake and functions on quaternions, as a script that is shown to users has it
in it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.tree import default_model_instance
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.rotation import conjugate, from_vector, multiply, norm, rotate


class DrakeStepper:
    """Advances a system by equal steps.

    Drake's ball joint has roll, pitch and yaw, singular at a pitch of 90°. Its frame on the parent
    is a parameter, which is turned to where the joint has got, and the angles are 0 again.

    Args:
        system: That is simulated.
        plant: In it.
        balls: Its ball joints.
        scheme: Of the integrator; "" where the plant steps itself.
        step: [s]
    """

    # Of roll, pitch or yaw, from which on frames are turned [rad].
    _turn = 0.3

    def __init__(
        self, system: Any, plant: Any, balls: Sequence[Any], scheme: str, step: float
    ) -> None:
        self._plant, self._scheme, self._step = plant, scheme, step
        # Drake warns that the ground meets nothing deformable.
        logger = logging.getLogger("drake")
        level = logger.level
        logger.setLevel(logging.ERROR)
        self._simulator = Simulator(system)
        logger.setLevel(level)
        self._root = self._simulator.get_mutable_context()
        self.context = plant.GetMyMutableContextFromRoot(self._root)
        if scheme:
            integrator = ResetIntegratorFromFlags(self._simulator, scheme, step)
            integrator.set_fixed_step_mode(True)
        self._frames = [ball.frame_on_parent() for ball in balls]
        self._points = [frame.GetFixedPoseInBodyFrame().translation() for frame in self._frames]
        first = [(ball.position_start(), ball.velocity_start()) for ball in balls]
        at = np.array(first, dtype=int).reshape(-1, 2, 1) + np.arange(3)
        self._angles, self._spins = at[:, 0], at[:, 1]

    def start(self, q: Array, v: Array, turns: Array) -> None:
        """Put the system at coordinates, velocities and turns of the balls' frames (ball, 4)."""
        self._done = 0
        self._root.SetTime(0.0)
        self._put(q, v, turns)
        self._simulator.Initialize()

    def _put(self, q: Array, v: Array, turns: Array) -> None:
        self._plant.SetPositions(self.context, q)
        self._plant.SetVelocities(self.context, v)
        self.turns = turns / norm(turns)[:, None]
        for frame, turn, point in zip(self._frames, self.turns, self._points, strict=True):
            frame.SetPoseInParentFrame(self.context, RigidTransform(Quaternion(turn), point))

    def actuate(self, push: Array) -> None:
        """Let actuators push, and controllers lead coordinates and rates to 0 beside."""
        if len(push):
            self._plant.get_actuation_input_port().FixValue(self.context, push)
            desired = self._plant.get_desired_state_input_port(default_model_instance())
            desired.FixValue(self.context, np.zeros(2 * len(push)))

    def advance(self, count: int) -> None:
        """Take so many steps."""
        for each in [1] * count if self._frames else [count]:
            self._done += each
            # A plant that steps itself does so where an advance begins: the next step is due then.
            early = 0.0 if self._scheme else 0.5
            self._simulator.AdvanceTo((self._done - early) * self._step, False)
            if self._frames:
                self._recentre()

    def _recentre(self) -> None:
        q = self._plant.GetPositions(self.context)
        angles = q[self._angles]
        if self._scheme:
            if np.abs(angles).max() < self._turn:
                return
            turn = of_angles(angles)
        else:
            # A plant that steps itself adds a step's turn to the angles, which were 0. As angles
            # they would not be the turn of its angular velocity, but in the first order.
            turn = from_vector(angles)
        v = self._plant.GetVelocities(self.context)
        v[self._spins] = rotate(conjugate(turn), v[self._spins])
        q[self._angles] = 0.0
        self._put(q, v, multiply(self.turns, turn))


def of_angles(angles: Array) -> Array:
    """Give the rotations by roll, pitch and yaw, shape (…, 4)."""
    roll, pitch, yaw = (from_vector(angles[..., [k]] * np.eye(3)[k]) for k in range(3))
    return multiply(yaw, multiply(pitch, roll))
