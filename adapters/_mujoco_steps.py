"""How a run gets from frame to frame: in one call, or in finer steps where contact is near."""

from __future__ import annotations

from typing import Any, Protocol

import mujoco

from ._mujoco_contact import Spheres

__all__ = ["FinerNearGround", "OneCall", "Stepper"]

_EULER = mujoco.mjtIntegrator.mjINT_EULER


class Stepper(Protocol):
    """Moves a run's state on by a frame, under the inputs that are set."""

    remark: str
    """What the model's text does not tell about the steps."""

    def frame(self, model: Any, data: Any) -> None:
        """Step to the next frame; after a warning the state is of no use."""
        ...


class OneCall:
    """Equal steps, whatever touches."""

    def __init__(self, count: int) -> None:
        self._count = count
        self.remark = ""

    def frame(self, model: Any, data: Any) -> None:
        mujoco.mj_step(model, data, self._count)


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
        self, model: Any, spheres: Spheres, integrator: str, count: int, division: int
    ) -> None:
        self._spheres, self._count, self._division = spheres, count, division
        self._integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        self._finer = float(model.opt.timestep)
        self.remark = (
            " This is the model near the ground. Where no sphere can come down to it, integrator "
            f"{integrator} and timestep {self._step:.9g} are set for a step."
        )

    @property
    def _step(self) -> float:
        """In the air [s]."""
        return self._division * self._finer

    def frame(self, model: Any, data: Any) -> None:
        for _ in range(self._count):
            if not self._flies(model, data):
                self._lead(model, data, -0.5)
                mujoco.mj_step(model, data, self._division)
                self._lead(model, data, 0.5)
            if data.warning.number.any():
                return

    def _lead(self, model: Any, data: Any, steps: float) -> None:
        """Move velocities on by a part of a finer step where nothing touches.

        Those of semi-implicit Euler belong to half a step before its positions. Taken for the
        positions' own they would lift every bounce by g h v.
        """
        if self._spheres.gaps(model, data).min() > 0.0:
            mujoco.mj_forward(model, data)
            data.qvel += steps * self._finer * data.qacc

    def _flies(self, model: Any, data: Any) -> bool:
        """Take one step in the air, or leave everything as it is where a sphere may touch."""
        if self._spheres.may_touch(model, data, self._step):
            return False
        before = data.time, data.qpos.copy(), data.qvel.copy()
        model.opt.integrator, model.opt.timestep = self._integrator, self._step
        mujoco.mj_step(model, data)
        model.opt.integrator, model.opt.timestep = _EULER, self._finer
        if self._spheres.gaps(model, data).min() >= 0.0:
            return True
        # Driven down harder than foreseen.
        data.time, data.qpos[:], data.qvel[:] = before
        return False
