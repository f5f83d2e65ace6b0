"""Equations of motion of any mechanism, and the accelerations that they give.

They use maximal coordinates (`dynamics`), unless rotors, dry friction, stops or couplings act on
coordinates of joints: then they use those of the mechanism's tree (`compiled`).
"""

from __future__ import annotations

import functools

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.dynamics import Dynamics, maximal_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

_AT_ONCE = 256  # states; more only cost memory
_HOLLOW = 1e-12  # of mass · length²: constraints at that distance lose four digits of the inertia


@functools.lru_cache(maxsize=64)
def dynamics_of(mechanism: Mechanism) -> Dynamics:
    """Prepare the equations of motion of a mechanism (once each)."""
    if mechanism.rotors or mechanism.couplings or mechanism.braked:
        return _TreeDynamics(mechanism)
    return maximal_of(mechanism)


class _TreeDynamics(Dynamics):
    """Equations with effects on coordinates of a tree; their use imports a compiler."""

    def accelerations(
        self, state: Array, force: Array, torque: Array
    ) -> tuple[Array, Array, Array]:
        twist_rates = _on_tree(self.mechanism, state, force, torque)
        whole = np.pad(twist_rates, ((0, 0), (0, 1), (0, 0)))
        return whole[..., :3], whole[..., 3:], np.ones(len(state))

    def project(self, state: Array) -> Array:
        if not self.mechanism.couplings:
            return super().project(state)
        from mbds_xsim.reference.compiled import projected

        return projected(self.mechanism, state)


def _on_tree(mechanism: Mechanism, states: Array, force: Array, torque: Array) -> Array:
    from mbds_xsim.reference.compiled import body_accelerations

    return body_accelerations(mechanism, states, force, torque)


def accelerations(
    mechanism: Mechanism, bodies: BodyStates, force: Array, torque: Array, *, many: bool = False
) -> tuple[Array, Array]:
    """Evaluate the equations of motion at any states, without contact.

    Args:
        mechanism: Mechanism that moves.
        bodies: States that keep the joints together, with any leading axes.
        force: Forces in W on the centres of mass [N], shape (…, body, 3).
        torque: Torques about the hinges of `Mechanism.hinges` [N·m], followed by the pushes of the
            drives, shape (…, hinge + drive).
        many: Whether it pays to load compiled kernels, where these have the same equations.

    Returns:
        Accelerations of the centres of mass [m/s²] and angular accelerations [rad/s²] in W, shapes
        (…, body, 3).
    """
    dynamics, shape = dynamics_of(mechanism), bodies.position.shape
    flat = (np.asarray(values, dtype=float) for values in vars(bodies).values())
    state = dynamics.pack(BodyStates(*(values.reshape(-1, *values.shape[-2:]) for values in flat)))
    force = np.broadcast_to(force, shape).reshape(-1, *shape[-2:])
    inputs = len(mechanism.hinges) + len(mechanism.drives)
    torque = np.broadcast_to(torque, (*shape[:-2], inputs)).reshape(len(state), inputs)
    if _hollow(mechanism) or (many and _turns_bodies_alone(mechanism)):
        twist_rates = _on_tree(mechanism, state, force, torque)
        return twist_rates[..., :3].reshape(shape), twist_rates[..., 3:].reshape(shape)
    parts = [slice(k, k + _AT_ONCE) for k in range(0, len(state), _AT_ONCE)]
    rates = [dynamics.derivative(state[part], force[part], torque[part]) for part in parts]
    rate = dynamics.unpack(np.concatenate([*rates, state[:0]]))
    return rate.velocity.reshape(shape), rate.angular_velocity.reshape(shape)


@functools.lru_cache(maxsize=64)
def _hollow(mechanism: Mechanism) -> bool:
    """Whether a body has so little inertia that maximal coordinates lose it in rounding."""
    least = np.linalg.eigvalsh(mechanism.inertia)[:, 0]
    return bool((least < _HOLLOW * mechanism.mass * mechanism.scene.length**2).any())


def _turns_bodies_alone(mechanism: Mechanism) -> bool:
    """Whether accelerations depend on the bodies' rotation only, and not on gaps in joints."""
    closes = mechanism.loops or mechanism.distances or mechanism.springs
    return not closes and all(joint.kind == "ball" for joint in mechanism.joints)
