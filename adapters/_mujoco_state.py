"""MuJoCo's qpos and qvel from the coordinates of the spanning tree."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.joint_space import LinkStates
from mbds_xsim.mechanism import Mechanism

from ._mujoco_cardan import angles, cross_axes

__all__ = ["Coordinates"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Coordinates:
    """Where each link's coordinates lie in qpos and qvel.

    MuJoCo's ball joint turns child to parent with its rate in the child's frame, its free joint
    has a velocity in W and a rate in the body's frame: as in `LinkStates`. Rods with an axis in
    `idle` hang on Cardan joints.
    """

    def __init__(self, model: Any, mechanism: Mechanism, idle: Array) -> None:
        kinds = [
            "cardan" if idle[link.body].any() else link.joint.kind if link.joint else "free"
            for link in mechanism.links
        ]
        self._sizes = (model.nq, model.nv)
        # MuJoCo numbers bodies depth first, the links breadth first: only names tell.
        bodies = [model.body(mechanism.scene.bodies[link.body].name).id for link in mechanism.links]
        first = model.body_jntadr[bodies]
        qpos, qvel = model.jnt_qposadr[first], model.jnt_dofadr[first]

        def of(*wanted: str) -> Indices:
            return np.array([k for k, kind in enumerate(kinds) if kind in wanted], dtype=np.int64)

        self._scalar, self._ball, self._free = of("hinge", "slider"), of("ball"), of("free")
        self._scalar_at = qpos[self._scalar], qvel[self._scalar]
        self._ball_at = (
            qpos[self._ball, None] + np.arange(4),
            qvel[self._ball, None] + np.arange(3),
        )
        self._free_at = (
            qpos[self._free, None] + np.arange(7),
            qvel[self._free, None] + np.arange(6),
        )
        self._cardan = of("cardan")
        self._cross = cross_axes(idle[[mechanism.links[k].body for k in self._cardan]])
        self._cardan_at = (
            qpos[self._cardan, None] + np.arange(2),
            qvel[self._cardan, None] + np.arange(2),
        )
        self.second = self._cardan_at[0][:, 1]
        """Places in qpos of the Cardan joints' second angles; a right angle is where they lock."""

    def from_links(self, links: LinkStates) -> tuple[Array, Array]:
        """Give qpos (…, nq) and qvel (…, nv)."""
        lead = links.coordinate.shape[:-1]
        qpos, qvel = (np.zeros((*lead, size)) for size in self._sizes)
        scalar, ball, free = self._scalar, self._ball, self._free
        qpos[..., self._scalar_at[0]] = links.coordinate[..., scalar]
        qvel[..., self._scalar_at[1]] = links.rate[..., scalar]
        qpos[..., self._ball_at[0]] = links.rotation[..., ball, :]
        qvel[..., self._ball_at[1]] = links.angular_velocity[..., ball, :]
        qpos[..., self._cardan_at[0]], qvel[..., self._cardan_at[1]] = angles(
            links.rotation[..., self._cardan, :],
            links.angular_velocity[..., self._cardan, :],
            self._cross,
        )
        qpos[..., self._free_at[0]] = np.concatenate(
            [links.position[..., free, :], links.rotation[..., free, :]], axis=-1
        )
        qvel[..., self._free_at[1]] = np.concatenate(
            [links.velocity[..., free, :], links.angular_velocity[..., free, :]], axis=-1
        )
        return qpos, qvel
