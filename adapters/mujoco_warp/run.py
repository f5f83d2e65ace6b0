"""A scene loaded into MuJoCo Warp: rollouts of whole batches, and the readback of its model."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import to_bodies
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Readback

from ..mujoco.contact import Impact
from ..mujoco.model import StepOptions
from ..mujoco.run import ModelRun
from ..mujoco.spinless import Bending
from .worlds import Worlds


def stepping(step: float, loop: float, link: float) -> StepOptions:
    """Return the options of stepping in MuJoCo's terms.

    The solver is conjugate gradients, as Newton's matrix is too ill-conditioned for single
    precision: its condition number is 3e8 in 2ladder, and its factors become NaN.

    Args:
        step: Step [s].
        loop: Time constant of loops, in steps.
        link: Time constant of distance links, in steps.
    """
    return StepOptions(
        "RK4", step, "CG", step * loop, step * link, Impact(0.0, 1),
        hard_limits=True, jacobian="sparse", resets=False,
    )  # fmt: skip


class WarpRun(Bending):
    """A run of MuJoCo's model, stepped by Warp's kernels.

    Args:
        mechanism: Mechanism of the scene.
        stepping: Options of stepping.
        count: Number of steps of a frame.
        device: Warp's name of the device.
        idle: Axes of rods that are left without spin, as in `ModelRun`.
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
        self.size = self._host.size

    def simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        host, torque = self._host, with_pushes(self._mechanism.drives, batch.torque)
        start, bodies = host.start(batch), host.bodies
        q, u = self._worlds.step_frames(start, batch.force, torque, bodies, self._count)
        states = to_bodies(self._mechanism, host.coordinates.to_links(q, u))
        bend = np.abs(q[..., host.coordinates.second]).max(axis=(1, 2), initial=0.0)
        return host.truncate(batch, states, [None] * len(batch)), bend

    def readback(self, batch: Batch) -> Readback:
        self._worlds.read(self._host.start(batch[:1]), self._host.data)
        return self._host.read()

    def native(self, batch: Batch) -> str:
        return self._host.native(batch)

    def close(self) -> None:
        self._host.close()
        vars(self).pop("_worlds", None)
