"""Steps of a Drake system that keep ball joints away from their singular pitch.

The module needs only Drake and quaternion functions, because the scripts shown to users contain
its source.
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
    """A stepper that advances a system by equal steps.

    Drake's ball joint has roll, pitch and yaw, singular at a pitch of 90°. Its frame on the parent
    is a parameter: turning that frame to the joint's present rotation resets the angles to 0.

    Args:
        system: The system to simulate.
        plant: Its plant.
        balls: The plant's ball joints.
        scheme: Name of the integrator; "" if the plant steps itself.
        step: Step [s].
    """

    # Roll, pitch or yaw from which on frames are turned [rad].
    _turn = 0.3

    def __init__(
        self, system: Any, plant: Any, balls: Sequence[Any], scheme: str, step: float
    ) -> None:
        self._plant, self._scheme, self._step = plant, scheme, step
        # Silence Drake's warning that the ground meets nothing deformable.
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
        """Set coordinates, velocities and the turns of the balls' frames (ball, 4) at time 0."""
        self._done = 0
        self._root.SetTime(0.0)
        self._put(q, v, turns)
        self._simulator.Initialize()

    def _put(self, q: Array, v: Array, turns: Array) -> None:
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            raise ValueError("a coordinate or rate is not finite")  # Drake would end the process
        self._plant.SetPositions(self.context, q)
        self._plant.SetVelocities(self.context, v)
        self.turns = turns / norm(turns)[:, None]
        for frame, turn, point in zip(self._frames, self.turns, self._points, strict=True):
            frame.SetPoseInParentFrame(self.context, RigidTransform(Quaternion(turn), point))

    def actuate(self, push: Array) -> None:
        """Set the actuators' pushes; their controllers also lead coordinates and rates to 0."""
        if len(push):
            self._plant.get_actuation_input_port().FixValue(self.context, push)
            desired = self._plant.get_desired_state_input_port(default_model_instance())
            desired.FixValue(self.context, np.zeros(2 * len(push)))

    def advance(self, count: int) -> None:
        """Take `count` steps."""
        for each in [1] * count if self._frames else [count]:
            self._done += each
            # A plant steps itself at a step's start; half a step early, the next is not yet due.
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
            # A plant that steps itself adds a step's rotation vector to the angles, which were 0.
            # Read as angles, it would be the turn of the angular velocity to first order only.
            turn = from_vector(angles)
        v = self._plant.GetVelocities(self.context)
        v[self._spins] = rotate(conjugate(turn), v[self._spins])
        q[self._angles] = 0.0
        self._put(q, v, multiply(self.turns, turn))


def of_angles(angles: Array) -> Array:
    """Return the rotations with given roll, pitch and yaw, shape (…, 4)."""
    roll, pitch, yaw = (from_vector(angles[..., [k]] * np.eye(3)[k]) for k in range(3))
    return multiply(yaw, multiply(pitch, roll))
