"""Between MuJoCo's qpos and qvel and the coordinates of the spanning tree."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.joint_space import LinkStates
from mbds_xsim.mechanism import Mechanism

from ._mujoco_cardan import angles, cross_axes, turned

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
        self._link_count = len(kinds)
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

    def bend(self, qpos: Array) -> Array:
        """Largest second angle of all Cardan joints [rad]; a right angle is where they lock."""
        return np.asarray(np.abs(qpos[..., self._cardan_at[0][:, 1]]).max(axis=-1, initial=0.0))

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

    def to_links(self, qpos: Array, qvel: Array) -> LinkStates:
        """Read qpos (…, nq) and qvel (…, nv)."""
        lead = (*qpos.shape[:-1], self._link_count)
        scalar, ball, free = self._scalar, self._ball, self._free
        links = LinkStates(
            rotation=np.zeros((*lead, 4)),
            angular_velocity=np.zeros((*lead, 3)),
            coordinate=np.zeros(lead),
            rate=np.zeros(lead),
            position=np.zeros((*lead, 3)),
            velocity=np.zeros((*lead, 3)),
        )
        links.coordinate[..., scalar] = qpos[..., self._scalar_at[0]]
        links.rate[..., scalar] = qvel[..., self._scalar_at[1]]
        links.rotation[..., self._cardan, :], links.angular_velocity[..., self._cardan, :] = turned(
            qpos[..., self._cardan_at[0]], qvel[..., self._cardan_at[1]], self._cross
        )
        links.rotation[..., ball, :] = qpos[..., self._ball_at[0]]
        links.angular_velocity[..., ball, :] = qvel[..., self._ball_at[1]]
        pose, twist = qpos[..., self._free_at[0]], qvel[..., self._free_at[1]]
        links.position[..., free, :], links.rotation[..., free, :] = pose[..., :3], pose[..., 3:]
        links.velocity[..., free, :] = twist[..., :3]
        links.angular_velocity[..., free, :] = twist[..., 3:]
        return links
