"""Bodies' states, frame by frame, as MuJoCo's kinematics give them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.joint_space import BodyStates

__all__ = ["Frames"]

Array = NDArray[np.float64]


class Frames:
    """Trajectories under way, all frames not a number at first.

    MuJoCo numbers bodies depth first, W the first, and gives rates about the centre of mass of the
    tree that a body belongs to: the numbers are sorted out once, at the end.

    Args:
        model: The compiled model.
        data: Its state.
        bodies: MuJoCo's numbers of the scene's bodies.
        count: Trajectories.
        frames: Frames of each.
    """

    def __init__(
        self, model: Any, data: Any, bodies: NDArray[np.int64], count: int, frames: int
    ) -> None:
        self._model, self._data, self._bodies = model, data, bodies
        self._roots = model.body_rootid[bodies]
        self._told = (data.xipos[1:], data.xquat[1:], data.cvel[1:], data.subtree_com[1:])
        self._kept = tuple(np.full((count, frames, *told.shape), np.nan) for told in self._told)

    def keep(self, row: int, frame: int, *, placed: bool = False) -> None:
        """Keep the present state; bodies may be placed by its coordinates already."""
        model, data = self._model, self._data
        if not placed:
            mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        at = row, frame
        place, turn, twist, centre = self._kept
        place[at], turn[at], twist[at], centre[at] = self._told

    def states(self) -> BodyStates:
        """Give what was kept, of the scene's bodies."""
        place, turn, twist, centre = self._kept
        bodies, roots = self._bodies - 1, self._roots - 1
        position, rates = place[:, :, bodies], twist[:, :, bodies]
        spin = np.ascontiguousarray(rates[..., :3])
        velocity = rates[..., 3:] + rotation.cross(spin, position - centre[:, :, roots])
        return BodyStates(position, turn[:, :, bodies], velocity, spin)
