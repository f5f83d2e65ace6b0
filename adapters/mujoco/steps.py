"""How a run gets from frame to frame: in equal steps, in more where joints turn fast, in finer ones
near the ground."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from mbds_xsim.base.arrays import Index

from .contact import SphereGeoms

_EULER = mujoco.mjtIntegrator.mjINT_EULER
# Faster than that, a motion has other troubles than its steps.
_MOST = 64


class OneCall:
    """Equal steps, whatever touches.

    As the others it has a `remark`, what the model's text does not tell about the steps, and says
    by `placed` whether a frame leaves bodies and geoms where the coordinates say.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self.remark, self.placed = "", False

    def frame(self, model: Any, data: Any) -> None:
        """Step to the next frame; after a warning the state is of no use."""
        mujoco.mj_step(model, data, self._count)


class FinerWhereFast:
    """The faster a joint turns, the more steps a frame takes.

    The error of a step goes with the fifth power of the angle that joints turn in it, so equal
    steps spend most of their time where nothing happens. Multiples of `count` keep the ratios of
    runs with 1, 2 and 4 times as many steps, so orders of convergence can be measured.

    Args:
        model: The compiled model, with the step of such a frame.
        turning: Places of the angular rates in qvel, one or more.
        count: Steps of a frame in which nothing turns fast.
        turn: Angle that a joint may turn in a frame before it takes twice as many [rad].
    """

    def __init__(self, model: Any, turning: Index, count: int, turn: float) -> None:
        self._count, self._step = count, float(model.opt.timestep)
        self._rate = turn / (count * self._step)
        self._square = self._rate**2
        # A slice is a third faster to take.
        self._turning = slice(None) if len(turning) == model.nv else turning
        self.remark = (
            f" A frame takes {count} steps times the fastest rate of a joint, counted in "
            f"{self._rate:.9g} rad/s and rounded up, {_MOST} times at most."
        )
        self.placed = False

    def frame(self, model: Any, data: Any) -> None:
        rates = data.qvel[self._turning]
        # All of them together are seldom too fast, and quicker to ask. NaN counts as slow.
        if not rates.dot(rates) > self._square:
            mujoco.mj_step(model, data, self._count)
            return
        fastest = max(map(abs, rates.tolist())) / self._rate
        times = max(1, math.ceil(min(fastest, _MOST)))
        model.opt.timestep = self._step / times
        mujoco.mj_step(model, data, self._count * times)
        model.opt.timestep = self._step


def turning_rates(model: Any) -> Index:
    """Find the rates of qvel that are angular."""
    kinds = mujoco.mjtJoint
    angular = []
    for kind, first in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        angular += {
            kinds.mjJNT_HINGE: [first],
            kinds.mjJNT_BALL: [first, first + 1, first + 2],
            kinds.mjJNT_FREE: [first + 3, first + 4, first + 5],
        }.get(mujoco.mjtJoint(kind), [])
    return np.array(angular, dtype=np.int64)


class FinerNearGround:
    """Steps of the run's method in the air; near the ground each is divided into finer ones.

    The finer ones are semi-implicit Euler's, to which the model's impact law is tied.

    Args:
        model: The compiled model, with the finer step.
        spheres: Its contact spheres.
        integrator: MuJoCo's name of the method in the air.
        count: Steps of a frame.
        division: Finer steps of a step.
    """

    def __init__(
        self, model: Any, spheres: SphereGeoms, integrator: str, count: int, division: int
    ) -> None:
        self._spheres, self._count, self._division = spheres, count, division
        self._integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        self._finer = float(model.opt.timestep)
        self._step = division * self._finer  # in the air
        # What is less above the ground than it falls in a finer step rattles and does not fly.
        self._lifted = float(np.linalg.norm(model.opt.gravity)) * self._finer**2
        self._left_at, self._gap, self._low, self._until = math.nan, np.empty(0), 0.0, -math.inf
        self.remark = (
            " This is the model near the ground. Where no sphere can come down to it, integrator "
            f"{integrator} and timestep {self._step:.9g} are set for a step."
        )
        self.placed = True  # to look for the ground

    def frame(self, model: Any, data: Any) -> None:
        left = self._count
        # What the last frame left behind holds on, unless the state was put anew.
        if data.time != self._left_at:
            self._look(model, data)
        elif not self._spheres.free:  # drives may pull in another way now
            self._until = -math.inf
        while left:
            aloft = self._aloft(model, data, left)
            if not (aloft and self._flown(model, data, aloft)):
                self._step_near(model, data)
                aloft = 1
            left -= aloft
        self._left_at = data.time

    def _look(self, model: Any, data: Any) -> None:
        self._gap, self._low = self._spheres.gaps(model, data)
        self._until = -math.inf

    def _aloft(self, model: Any, data: Any, left: int) -> int:
        """Steps of those left in which no sphere can reach the ground."""
        time, wanted = self._until - data.time, left * self._step
        if time < wanted:
            time = self._spheres.time_aloft(model, data, self._gap, self._low, self._step, wanted)
            self._until = data.time + time
        return int(min(left, time / self._step))  # all that are left where it is NaN

    def _step_near(self, model: Any, data: Any) -> None:
        self._lead(model, data, self._low, -0.5)
        mujoco.mj_step(model, data, self._division)
        self._look(model, data)
        self._lead(model, data, self._low, 0.5)

    def _lead(self, model: Any, data: Any, low: float, steps: float) -> None:
        """Move velocities on by a part of a finer step where nothing touches.

        Those of semi-implicit Euler belong to half a step before its positions. Taken for the
        positions' own they would lift every bounce by g h v.
        """
        if low > self._lifted:
            mujoco.mj_forward(model, data)
            data.qvel += steps * self._finer * data.qacc

    def _flown(self, model: Any, data: Any, count: int) -> bool:
        """Take steps in the air; none, and leave everything as it is, where a sphere comes down."""
        before, options = (data.time, data.qpos.copy(), data.qvel.copy()), model.opt
        options.integrator, options.timestep = self._integrator, self._step
        mujoco.mj_step(model, data, count)
        options.integrator, options.timestep = _EULER, self._finer
        gap, low = self._spheres.gaps(model, data)
        if low >= 0.0:
            self._gap, self._low = gap, low
            return True
        # Driven down harder than foreseen.
        data.time, data.qpos[:], data.qvel[:] = before
        return False
