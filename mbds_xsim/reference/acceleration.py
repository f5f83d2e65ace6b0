"""Accelerations that the equations of motion give at any states."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.reference.dynamics import dynamics_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]

_AT_ONCE = 256  # states; more only cost memory


def accelerations(
    mechanism: Mechanism, bodies: BodyStates, force: Array, torque: Array
) -> tuple[Array, Array]:
    """Evaluate the equations of motion, without contact.

    Args:
        mechanism: Whose motion.
        bodies: States that keep the joints together, with any leading axes.
        force: In W on the centres of mass [N], shape (…, body, 3).
        torque: About the hinges of `Mechanism.hinges` [N·m], shape (…, hinge).

    Returns:
        Of the centres of mass in W [m/s²] and angular in W [rad/s²], shapes (…, body, 3).
    """
    lead = bodies.position.shape[:-2]
    count = mechanism.body_count
    dynamics = dynamics_of(mechanism)
    flat = BodyStates(
        *(
            np.asarray(getattr(bodies, key), dtype=float).reshape(-1, count, width)
            for key, width in (
                ("position", 3),
                ("native", 4),
                ("velocity", 3),
                ("angular_velocity", 3),
            )
        )
    )
    state = dynamics.pack(flat)
    force = np.broadcast_to(force, (*lead, count, 3)).reshape(-1, count, 3)
    hinges = len(mechanism.hinges)
    torque = np.broadcast_to(torque, (*lead, hinges)).reshape(len(state), hinges)
    parts = [slice(k, k + _AT_ONCE) for k in range(0, len(state), _AT_ONCE)]
    rates = [dynamics.derivative(state[part], force[part], torque[part]) for part in parts]
    rate = dynamics.unpack(np.concatenate([*rates, state[:0]]))
    shape = (*lead, count, 3)
    return rate.velocity.reshape(shape), rate.angular_velocity.reshape(shape)
