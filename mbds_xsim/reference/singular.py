"""Singular poses, where constraints lose rank and a mechanism could go on in more than one way.

A crank in line with its rod is the usual case. Accelerations are smooth along the branch that a
motion follows, even through such a pose, although their equations cannot be solved there. So near
it they are interpolated from poses on both sides, where the equations are well conditioned. These
poses lie along the velocity, and each is projected onto the constraints.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array

if TYPE_CHECKING:
    from mbds_xsim.reference.dynamics import Dynamics

BIFURCATION = (
    "the start is a bifurcation: the mechanism is in a singular pose, and its velocities (or, at "
    "rest, its forces) belong to none of the motions possible from there; start it elsewhere, or "
    "with the rates of one of them"
)

_X, _Q, _V, _W = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
# Distance of neighbours: largest turn [rad] or largest displacement over the scene's length. If it
# is smaller, rounding errors grow with its inverse square; if larger, interpolation errors grow.
_APART = 0.03
_PLACES = np.array([-6, -5, -4, -3, -2, -1, 1, 2, 3, 4, 5, 6])
# Lagrange's weights of those places for the value at 0, exact for polynomials of degree 11.
_WEIGHTS = np.array([-1, 12, -66, 220, -495, 792, 792, -495, 220, -66, 12, -1]) / 924.0
# Shares grow with the square of the distance from a singular pose, by more than this to the next
# neighbour; otherwise the pose is regular, and they are small because masses differ.
_CLEARER = 4.0
_PASSES = 4
_STILL = 1e-9
_SAME = 1e-6
_BESIDE, _WAY, _SEED = 2, 0.1, 20240911
_TOLERANCE = 1e-9  # largest residual after Newton's method, over the scene's length


def interpolated(
    dynamics: Dynamics, state: Array, force: Array, torque: Array, rate: Array, share: float
) -> Array:
    """Time derivative of a state near a singular pose, on the branch that its velocity follows.

    Args:
        dynamics: Equations of motion.
        state: State, shape (body + world, 13).
        force: Forces, shape (body, 3).
        torque: Torques about hinges, followed by the pushes of drives, shape (hinge + drive,).
        rate: Derivative without the rows that are nearly dependent; returned if the pose turns out
            to be regular, or if nothing moves.
        share: Independent share of the rows at the state.
    """
    near = _neighbours(dynamics, state, rate[:, 7:], share)
    if near is None:
        return rate
    loads = (np.broadcast_to(load, (len(near), *load.shape)) for load in (force, torque))
    return np.tensordot(_WEIGHTS, dynamics.rate(near, *loads)[0], axes=1)


def projected_onto_branch(
    dynamics: Dynamics, state: Array, projected: Array, share: float
) -> Array:
    """Project one state onto the branch that its velocity follows.

    Args:
        dynamics: Equations of motion.
        state: State, shape (body + world, 13).
        projected: The state projected onto the well-conditioned constraints; returned if the pose
            turns out to be regular, or if nothing moves.
        share: Independent share of the rows at the state.
    """
    near = _neighbours(dynamics, state, np.zeros_like(state[:, 7:]), share)
    return projected if near is None else np.tensordot(_WEIGHTS, near, axes=1)


def _neighbours(
    dynamics: Dynamics, state: Array, acceleration: Array, share: float
) -> Array | None:
    """States on the constraints at `_PLACES` before and after a state.

    None if the state is regular, or if nothing moves. The neighbours have its velocities, as far as
    the constraints allow.
    """
    direction = _direction(dynamics, state[:, 7:], acceleration)
    if direction is None:
        return None
    near = moved(state, _APART * _PLACES[:, None, None] * direction)
    for _ in range(_PASSES):
        near, shares = dynamics.closest(near)
    return near if shares[np.abs(_PLACES) == 1].min() > _CLEARER * share else None


def has_branch(dynamics: Dynamics, state: Array, force: Array, torque: Array) -> bool:
    """Whether a state is at a regular pose, or at a singular one and on one of its branches."""
    rates, shares = dynamics.rate(state[None], force[None], torque[None])
    if not shares[0] < dynamics.near:
        return True
    rate = interpolated(dynamics, state, force, torque, rates[0], float(shares[0]))
    moving = np.abs(state[:, _V]).max() + np.abs(state[:, _W]).max()
    at_rest = moving <= _STILL * np.sqrt(np.abs(rate[:, 7:]).max())
    # At rest the forces alone choose a branch, unless they push against every one.
    motion, branch = (rates[0, :, 7:], rate[:, 7:]) if at_rest else (state[:, _V], rate[:, _X])
    return bool(np.abs(branch - motion).max() <= _SAME * max(np.abs(motion).max(), moving))


def typical_states(dynamics: Dynamics, pose: Array) -> Array:
    """Return a pose, shape (1, body + world, 13), and some near it, few of which are singular.

    At nearly all poses the largest possible number of constraints is independent.
    """
    beside = np.repeat(pose, _BESIDE, axis=0)
    random = np.random.default_rng(_SEED)
    beside[:, :-1, 7:] = random.standard_normal((_BESIDE, pose.shape[1] - 1, 6))
    ways = dynamics.closest(beside)[0][..., 7:]
    ways *= _WAY / np.maximum(_STILL, [[[_size(dynamics, way)]] for way in ways])
    near = np.concatenate([moved(pose[0], way[None]) for way in ways])
    for _ in range(2 * _PASSES):
        near, _ = dynamics.closest(near)
    met = np.abs(dynamics.residual(near)).max(axis=1) < _TOLERANCE * dynamics.length
    return np.concatenate([pose, near[met]])


def _direction(dynamics: Dynamics, twist: Array, acceleration: Array) -> Array | None:
    """Twists of the motion, or at rest its accelerations, of `_size` 1, (body + world, 6)."""
    speed, change = _size(dynamics, twist), _size(dynamics, acceleration)
    if not 0.0 < speed + change < np.inf:
        return None
    return twist / speed if speed > _STILL * np.sqrt(change) else acceleration / change


def _size(dynamics: Dynamics, twist: Array) -> float:
    """Largest rotation, or displacement over the scene's length."""
    return float(max(np.abs(twist[:, :3]).max() / dynamics.length, np.abs(twist[:, 3:]).max()))


def moved(state: Array, way: Array) -> Array:
    """Move a state by displacements and rotation vectors, shape (way, body + world, 6)."""
    new = np.repeat(state[None], len(way), axis=0)
    new[..., _X] += way[..., :3]
    new[..., _Q] = rotation.multiply(rotation.from_vector(way[..., 3:]), new[..., _Q])
    return new
