"""How far an impulse of the ground on one sphere can move each body of a mechanism."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]


@functools.lru_cache(maxsize=64)
def responses(mechanism: Mechanism) -> tuple[Array, Array]:
    """Largest velocities that a unit impulse on a sphere's lowest point gives to each body.

    Over all directions of the impulse, at the reference pose, joints sharing in it by the least
    change of kinetic energy. Linear [1/kg] and angular [1/(kg·m)], each (sphere, body).
    """
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference.dynamics import dynamics_of

    spheres = len(mechanism.sphere_body)
    each, axis = (k.ravel() for k in np.indices((spheres, 3)))
    body, row = mechanism.sphere_body[each], np.arange(3 * spheres)
    arm = mechanism.sphere_offset[each]
    arm = arm - mechanism.sphere_radius[each, None] * np.array([0.0, 0.0, 1.0])
    push, shape = np.eye(3)[axis], (3 * spheres, mechanism.body_count)
    velocity, spin = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    velocity[row, body] = push / mechanism.mass[body, None]
    moment = rotation.cross(arm, push)
    spin[row, body] = np.linalg.solve(mechanism.inertia[body], moment[..., None])[..., 0]
    place = np.broadcast_to(mechanism.com, (*shape, 3)).copy()
    still = np.broadcast_to(rotation.IDENTITY, (*shape, 4)).copy()
    dynamics = dynamics_of(mechanism)
    pushed = dynamics.pack(BodyStates(place, still, velocity, spin))
    given = dynamics.unpack(dynamics.project(pushed))
    found = (given.velocity, given.angular_velocity)
    sizes = (np.linalg.norm(_matrices(each), ord=2, axis=(-2, -1)) for each in found)
    linear, angular = sizes
    return np.asarray(linear), np.asarray(angular)


def _matrices(velocity: Array) -> Array:
    """Of each sphere and body, with a column for each direction, (sphere, body, 3, 3)."""
    by_direction = velocity.reshape(-1, 3, *velocity.shape[1:])
    return np.moveaxis(by_direction, 1, -1)
