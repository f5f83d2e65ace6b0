"""Steppers over a frame: with equal steps, more where joints turn fast, finer near the ground."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from mbds_xsim.base.arrays import Array, Index

from .contact import SphereGeoms

_EULER = mujoco.mjtIntegrator.mjINT_EULER
_LIMIT = mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
# Largest factor; a faster motion has other problems than its steps.
_MOST = 64


class OneCall:
    """A stepper with equal steps, whatever touches.

    Like the others it has a `remark` on the steps, for the model's text, and `placed`, whether
    bodies and geoms are where the coordinates place them after a frame. `frame` steps to the next
    frame and returns why the trajectory ends there, "" if it does not.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self.remark, self.placed = "", False

    def frame(self, model: Any, data: Any) -> str:
        """Step to the next frame; after a warning the state is useless."""
        mujoco.mj_step(model, data, self._count)
        return ""


class FinerWhereFast:
    """A stepper that takes more steps in a frame the faster a joint turns.

    The error of a step grows with the fifth power of the angle that joints turn in it, so equal
    steps spend most of their time where nothing happens. Multiples of `count` keep the ratios of
    runs with 1, 2 and 4 times as many steps, so orders of convergence can be measured.

    Args:
        model: The compiled model, with the step of a frame in which nothing turns fast.
        turning: Places of the angular rates in qvel, one or more.
        count: Number of steps of such a frame.
        turn: Angle that a joint may turn in a frame before the frame takes more steps [rad].
    """

    def __init__(self, model: Any, turning: Index, count: int, turn: float) -> None:
        self._count, self._step = count, float(model.opt.timestep)
        self._rate = turn / (count * self._step)
        self._square = self._rate**2
        # Indexing with a slice is a third faster.
        self._turning = slice(None) if len(turning) == model.nv else turning
        self.remark = (
            f" A frame takes {count} steps times the fastest rate of a joint, counted in "
            f"{self._rate:.9g} rad/s and rounded up, {_MOST} times at most."
        )
        self.placed = False

    def frame(self, model: Any, data: Any) -> str:
        rates = data.qvel[self._turning]
        # Their sum of squares is quicker to test and seldom too large. NaN counts as slow.
        if not rates.dot(rates) > self._square:
            mujoco.mj_step(model, data, self._count)
            return ""
        fastest = max(map(abs, rates.tolist())) / self._rate
        times = max(1, math.ceil(min(fastest, _MOST)))
        model.opt.timestep = self._step / times
        mujoco.mj_step(model, data, self._count * times)
        model.opt.timestep = self._step
        return ""


def turning_rates(model: Any) -> Index:
    """Return the places of the angular rates in qvel."""
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
    """A stepper that takes the method's steps in the air and finer ones near the ground.

    The finer ones are semi-implicit Euler's, to which the model's impact law is tied.

    Args:
        model: The compiled model, with the finer step.
        spheres: Its contact spheres.
        integrator: MuJoCo's name of the method in the air.
        count: Number of steps of a frame.
        division: Number of finer steps of a step.
        lost: Reasons why a touch ends a trajectory, by spheres.
    """

    def __init__(
        self,
        model: Any,
        spheres: SphereGeoms,
        integrator: str,
        count: int,
        division: int,
        lost: dict[tuple[int, ...], str],
    ) -> None:
        self._spheres, self._count, self._division = spheres, count, division
        self._integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        self._lost = {spheres.geoms(pair): reason for pair, reason in lost.items()}
        self._finer = float(model.opt.timestep)
        self._step = division * self._finer  # in the air
        # A sphere with a smaller gap than it falls in a finer step rattles and does not fly.
        self._least_gap = float(np.linalg.norm(model.opt.gravity)) * self._finer**2
        self._end_time, self._gap, self._low, self._until = math.nan, np.empty(0), 0.0, -math.inf
        self.remark = (
            " This is the model near the ground. Where no sphere can come down to it, integrator "
            f"{integrator} and timestep {self._step:.9g} are set for a step."
        )
        self._near, self._far = model.jnt_solref.copy(), _stops_of_step(model, division)
        self._several = len(np.unique(model.body_rootid[1:])) > 1
        self._stops = bool((self._near != self._far).any())
        if self._stops:
            self.remark += (
                f" Stops then take a velocity in that step: solreflimit is divided by {division} "
                "squared, and by it."
            )
        self.placed = True  # by looking for the ground

    def frame(self, model: Any, data: Any) -> str:
        remaining = self._count
        # Results of the last frame stay valid unless the state was set anew.
        if data.time != self._end_time:
            self._look(model, data)
        elif not self._spheres.free:  # drives may now pull differently
            self._until = -math.inf
        while remaining:
            count = self._aloft(model, data, remaining)
            if not (count and self._fly(model, data, count)):
                if reason := self._step_near(model, data):
                    return reason
                count = 1
            remaining -= count
        self._end_time = data.time
        return ""

    def _look(self, model: Any, data: Any) -> None:
        self._gap, self._low = self._spheres.gaps(model, data)
        self._until = -math.inf

    def _aloft(self, model: Any, data: Any, remaining: int) -> int:
        """Return the number of steps, `remaining` at most, in which no sphere can touch."""
        time, horizon = self._until - data.time, remaining * self._step
        if time < horizon:
            time = self._spheres.time_aloft(model, data, self._gap, self._low, self._step, horizon)
            self._until = data.time + time
        return int(min(remaining, time / self._step))  # all that remain if it is NaN

    def _step_near(self, model: Any, data: Any) -> str:
        self._lead(model, data, -0.5)
        for _ in range(self._division if self._lost else 1):
            mujoco.mj_step(model, data, 1 if self._lost else self._division)
            for pair in data.contact.geom.tolist() if self._lost else ():
                if reason := self._lost.get(frozenset(pair)):
                    return reason
        self._look(model, data)
        self._lead(model, data, 0.5)
        return ""

    def _lead(self, model: Any, data: Any, steps: float) -> None:
        """Advance velocities of what touches nothing by a part of a finer step.

        Velocities of semi-implicit Euler belong to half a step before its positions. Without this
        shift every bounce would gain an energy of g h v per mass. While a stop acts there is no
        shift: its impulse, over the step, is a whole change of velocity.
        """
        near = self._low <= self._least_gap
        if near and not self._several:
            return
        mujoco.mj_forward(model, data)
        lead = steps * self._finer * data.qacc
        held: list[int] = []
        if near:
            held += self._spheres.trees(self._gap <= self._least_gap).tolist()
        if self._stops:
            stopped = data.efc_id[: data.nefc][data.efc_type[: data.nefc] == _LIMIT]
            held += model.body_rootid[model.jnt_bodyid[stopped]].tolist()
        if held:
            lead[np.isin(model.body_rootid[model.dof_bodyid], held)] = 0.0
        data.qvel += lead

    def _fly(self, model: Any, data: Any, count: int) -> bool:
        """Take steps in the air; if a sphere comes down, restore the state and return False."""
        before, options = (data.time, data.qpos.copy(), data.qvel.copy()), model.opt
        options.integrator, options.timestep = self._integrator, self._step
        model.jnt_solref[:] = self._far
        mujoco.mj_step(model, data, count)
        options.integrator, options.timestep = _EULER, self._finer
        model.jnt_solref[:] = self._near
        gap, low = self._spheres.gaps(model, data)
        if low >= 0.0:
            self._gap, self._low = gap, low
            return True
        # A sphere was driven down harder than foreseen.
        data.time, data.qpos[:], data.qvel[:] = before
        return False


def _stops_of_step(model: Any, division: int) -> Array:
    """Return the joints' solref for steps that are `division` times as long as the model's.

    Positive ones are time constants and ratios, as in MuJoCo's default, and belong to no step.
    """
    law = model.jnt_solref.copy()
    law[law[:, 0] < 0.0] /= (division**2, division)
    return np.asarray(law)
