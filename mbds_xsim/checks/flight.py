"""Steps in which nothing can touch the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import Mechanism

__all__ = ["flying"]

Mask = NDArray[np.bool_]


def flying(
    mechanism: Mechanism, bodies: BodyStates, frame: float, group: tuple[int, ...] | None = None
) -> Mask:
    """Find the steps in which no contact sphere of a group (or of all) can reach the ground.

    At both ends a sphere must be higher than it would fall, at its own speed and at what gravity
    adds to it, in a whole frame. Shape (trajectory, step).
    """
    own = np.isin(mechanism.sphere_body, range(mechanism.body_count) if group is None else group)
    carrier = mechanism.sphere_body[own]
    arm = rotation.rotate(bodies.native[:, :, carrier], mechanism.sphere_offset[own])
    height = bodies.position[:, :, carrier, 2] + arm[..., 2] - mechanism.sphere_radius[own]
    swing = np.cross(bodies.angular_velocity[:, :, carrier], arm)
    speed = np.abs(bodies.velocity[:, :, carrier, 2] + swing[..., 2])
    pull = float(np.linalg.norm(mechanism.scene.gravity))
    clear: Mask = np.all(height > frame * (speed + frame * pull), axis=2)
    return clear[:, 1:] & clear[:, :-1]
