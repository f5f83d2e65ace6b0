"""The points of a scene whose motion is published, and the graph over them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.markers import markers
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.sampling import noise_components
from mbds_xsim.scene import Scene
from mbds_xsim.state import Trajectory

__all__ = ["Points"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Points:
    """Particles, and stand-ins in bodies without any."""

    mechanism: Mechanism
    body: NDArray[np.int64]
    """Body of each point, shape (point,)."""
    offset: Array
    """From its centre of mass in the native frame [m], shape (point, 3)."""
    axes: list[int]
    """Components of W in which the scene moves."""

    @staticmethod
    def of(scene: Scene) -> Points:
        """Find the points of a scene."""
        mechanism = Mechanism.of(scene)
        return Points(mechanism, *markers(mechanism), noise_components(scene))

    def motion(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """Positions [m] and velocities [m/s], each of shape (trajectory, frame, point, axis)."""
        native = self.mechanism.native_rotation(trajectory.orientation)
        arm = rotation.rotate(native[..., self.body, :], self.offset)
        swing = rotation.cross(trajectory.angular_velocity[..., self.body, :], arm)
        position = trajectory.position[..., self.body, :] + arm
        velocity = trajectory.velocity[..., self.body, :] + swing
        if len(self.axes) == 3:
            return position, velocity
        return position[..., self.axes], velocity[..., self.axes]

    def graph(self) -> dict[str, NDArray[Any]]:
        """Nodes and edges; static nodes are numbered after the points."""
        scene = self.mechanism.scene
        edges = np.array(scene.edges, dtype=np.int64).reshape(-1, 2)
        shift = len(self.body) - scene.particle_count
        static = np.array(scene.anchors, dtype=np.float64).reshape(-1, 3)
        return {
            "graph/edge": np.where(edges >= scene.particle_count, edges + shift, edges),
            "graph/point_body": self.body,
            "graph/static_node": static[:, self.axes],
            "graph/body_name": np.array([body.name for body in scene.bodies]),
        }
