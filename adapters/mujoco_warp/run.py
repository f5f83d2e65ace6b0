"""A loaded scene: trajectories of whole batches out of it, and what the kernels hold."""

from __future__ import annotations

import dataclasses

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import to_bodies
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Readback

from ..mujoco.contact import HARDEST, Impact
from ..mujoco.model import StepOptions
from ..mujoco.run import ModelRun
from ..mujoco.spinless import Bending
from .worlds import Worlds


def stepping(step: float, loop: float, link: float) -> StepOptions:
    """Give the steps in MuJoCo's terms.

    Conjugate gradients, as Newton's matrix is too steep for single precision: its condition is
    3e8 in 2ladder, and its factors are not numbers.

    Args:
        step: [s].
        loop: Time constant of loops, in steps.
        link: That of distance links.
    """
    impact = Impact(0.0, 1, HARDEST)
    options = StepOptions("RK4", step, "CG", step * loop, step * link, impact, hard_limits=True)
    return dataclasses.replace(options, jacobian="sparse", resets=False)


class WarpRun(Bending):
    """MuJoCo's model, stepped by kernels.

    Args:
        mechanism: Of the scene.
        stepping: How the kernels step.
        count: Steps of a frame.
        device: That steps.
        idle: Axes of rods that are left without spin, as `ModelRun` has them.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        stepping: StepOptions,
        count: int,
        device: str,
        idle: Array | None = None,
    ) -> None:
        self._mechanism, self._count = mechanism, count
        self._host = ModelRun(mechanism, stepping, stepping.integrator, count, 0, 0.0, idle)
        model, data = self._host.model, self._host.data
        rows = data.ne + data.nf + len(mechanism.limited)
        self._worlds = Worlds(model, rows, device)
        self._bodies = np.array([model.body(body.name).id for body in mechanism.scene.bodies])
        self.size = self._host.size

    def simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        host, torque = self._host, with_pushes(self._mechanism.drives, batch.torque)
        q, u = self._worlds.stepped(
            host.start(batch), batch.force, torque, self._bodies, self._count
        )
        bodies = to_bodies(self._mechanism, host.coordinates.to_links(q, u))
        bend = np.abs(q[..., host.coordinates.second]).max(axis=(1, 2), initial=0.0)
        return host.finished(batch, bodies, [None] * len(batch)), bend

    def readback(self, batch: Batch) -> Readback:
        self._worlds.read(self._host.start(batch[:1]), self._host.data)
        return self._host.read()

    def native(self, batch: Batch) -> str:
        return self._host.native(batch)

    def close(self) -> None:
        self._host.close()
        vars(self).pop("_worlds", None)
