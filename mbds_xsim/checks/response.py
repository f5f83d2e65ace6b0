"""How far an impulse of the ground on one sphere can move each body of a mechanism."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]


def pushed(mechanism: Mechanism, bodies: BodyStates, sphere: NDArray[np.int64]) -> BodyStates:
    """Give the velocities that unit impulses on a sphere's lowest point make of bodies at rest.

    Joints share in an impulse by the least change of kinetic energy.

    Args:
        mechanism: Whose bodies.
        bodies: Where they are, shape (state, body, …).
        sphere: The one that is pushed in each state.

    Returns:
        States with these velocities, of impulses along x, y and z, shape (state, 3, body, …).
    """
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference.dynamics import dynamics_of

    each, axis = (k.ravel() for k in np.indices((len(sphere), 3)))
    row, body, states = np.arange(len(each)), mechanism.sphere_body[sphere][each], bodies[each]
    native, push = states.native[row, body], np.eye(3)[axis]
    arm = lowest(mechanism, native, sphere[each])
    turn = rotation.matrix(native)
    inertia = turn @ mechanism.inertia[body] @ np.swapaxes(turn, -1, -2)
    velocity, spin = np.zeros_like(states.velocity), np.zeros_like(states.velocity)
    velocity[row, body] = push / mechanism.mass[body, None]
    moment = rotation.cross(arm, push)
    spin[row, body] = np.linalg.solve(inertia, moment[..., None])[..., 0]
    dynamics = dynamics_of(mechanism)
    start = dynamics.pack(BodyStates(states.position, states.native, velocity, spin))
    found = dynamics.unpack(dynamics.project(start))
    shape = (len(sphere), 3, mechanism.body_count)
    return BodyStates(*(values.reshape(*shape, -1) for values in vars(found).values()))


def lowest(mechanism: Mechanism, native: Array, sphere: NDArray[np.int64]) -> Array:
    """Arms from centres of mass to the lowest points of spheres [m], by the bodies' turns."""
    arm = rotation.rotate(native, mechanism.sphere_offset[sphere])
    arm[..., 2] -= mechanism.sphere_radius[sphere]
    return arm


@functools.lru_cache(maxsize=64)
def responses(mechanism: Mechanism) -> tuple[Array, Array]:
    """Largest velocities that a unit impulse on a sphere's lowest point gives to each body.

    Over all directions of the impulse, at the reference pose. Linear [1/kg] and angular
    [1/(kg·m)], each (sphere, body).
    """
    shape = (len(mechanism.sphere_body), mechanism.body_count)
    place = np.broadcast_to(mechanism.com, (*shape, 3))
    still = np.broadcast_to(rotation.IDENTITY, (*shape, 4))
    pose = BodyStates(place, still, np.zeros_like(place), np.zeros_like(place))
    given = pushed(mechanism, pose, np.arange(shape[0]))
    linear, angular = (
        np.linalg.norm(np.moveaxis(each, 1, -1), ord=2, axis=(-2, -1))
        for each in (given.velocity, given.angular_velocity)
    )
    return np.asarray(linear), np.asarray(angular)
