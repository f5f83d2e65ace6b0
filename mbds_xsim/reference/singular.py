"""Singular poses: where constraints lose rank, and a mechanism could go on in more than one way.

Cranks that lie in line with their rod are the usual case. Accelerations are smooth along the branch
that a motion is on, through such a pose too, although the equations that give them cannot be solved
there. So near it they are interpolated between poses on both sides, along the velocity and each
put back onto the constraints: there everything is well conditioned.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array

BIFURCATION = (
    "the start is a bifurcation: the mechanism is in a singular pose, and its velocities (or, at "
    "rest, its forces) lead into none of the motions that are possible from there; start it "
    "elsewhere, or with rates of one of them"
)

_X, _Q, _V, _W = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
# Between neighbours: turn of the body that turns most [rad], or its way over the scene's length.
# Nearer, rounding errors grow with the inverse square; farther, so do those of interpolation.
_APART = 0.03
_PLACES = np.array([-6, -5, -4, -3, -2, -1, 1, 2, 3, 4, 5, 6])
# Lagrange's weights of those places for the value at 0, exact for polynomials of degree 11.
_WEIGHTS = np.array([-1, 12, -66, 220, -495, 792, 792, -495, 220, -66, 12, -1]) / 924.0
# Shares grow with the square of the distance from a singular pose, by more than this to the next
# neighbour; where they do not, they are small because masses differ.
_CLEARER = 4.0
_PASSES = 4
_STILL = 1e-9
_SAME = 1e-6
_BESIDE, _WAY, _SEED = 2, 0.1, 20240911
_MET = 1e-9  # residual that Newton's method leaves, over the scene's length


class Equations(Protocol):
    """Equations of motion that may be asked without regard to singular poses."""

    length: float
    """Of the scene [m]."""
    near: float
    """Independent share of the rows below which a pose may be singular."""

    def rate(self, state: Array, force: Array, torque: Array) -> tuple[Array, Array]:
        """Give time derivatives and independent shares."""
        ...

    def closest(self, state: Array) -> tuple[Array, Array]:
        """Put states onto the constraints; also gives independent shares."""
        ...

    def residual(self, state: Array) -> Array:
        """Give constraint residuals."""
        ...


def interpolated(
    dynamics: Equations, state: Array, force: Array, torque: Array, rate: Array, share: float
) -> Array:
    """Time derivative of a state near a singular pose, on the branch that its velocity is on.

    Args:
        dynamics: Equations of motion.
        state: Shape (body + world, 13).
        force: On it, shape (body, 3).
        torque: On it, shape (hinge,).
        rate: Its derivative where rows that are nearly dependent are left out; given back where
            the pose turns out to be regular, or nothing moves.
        share: The independent share of its rows.
    """
    near = _neighbours(dynamics, state, rate[:, 7:], share)
    if near is None:
        return rate
    loads = (np.broadcast_to(load, (len(near), *load.shape)) for load in (force, torque))
    return np.tensordot(_WEIGHTS, dynamics.rate(near, *loads)[0], axes=1)


def projected_onto_branch(
    dynamics: Equations, state: Array, projected: Array, share: float
) -> Array:
    """Put one state onto the branch that its velocity is on.

    Args:
        dynamics: Equations of motion.
        state: Shape (body + world, 13).
        projected: The same put onto the constraints that are well conditioned; given back where the
            pose turns out to be regular, or nothing moves.
        share: The independent share of the constraints.
    """
    near = _neighbours(dynamics, state, np.zeros_like(state[:, 7:]), share)
    return projected if near is None else np.tensordot(_WEIGHTS, near, axes=1)


def _neighbours(
    dynamics: Equations, state: Array, acceleration: Array, share: float
) -> Array | None:
    """States on the constraints at `_PLACES` before and behind one, if that is at a singular pose.

    They have its velocities, as far as the constraints let them.
    """
    direction = _direction(dynamics, state[:, 7:], acceleration)
    if direction is None:
        return None
    near = _moved(state, _APART * _PLACES[:, None, None] * direction)
    for _ in range(_PASSES):
        near, shares = dynamics.closest(near)
    return near if shares[np.abs(_PLACES) == 1].min() > _CLEARER * share else None


def has_branch(dynamics: Equations, state: Array, force: Array, torque: Array) -> bool:
    """Whether a state is at no singular pose, or on one of the branches that meet there."""
    rates, shares = dynamics.rate(state[None], force[None], torque[None])
    if not shares[0] < dynamics.near:
        return True
    rate = interpolated(dynamics, state, force, torque, rates[0], float(shares[0]))
    moving = np.abs(state[:, _V]).max() + np.abs(state[:, _W]).max()
    at_rest = moving <= _STILL * np.sqrt(np.abs(rate[:, 7:]).max())
    # Where nothing moves, the forces alone choose, unless they push against every branch.
    given, found = (rates[0, :, 7:], rate[:, 7:]) if at_rest else (state[:, _V], rate[:, _X])
    return bool(np.abs(found - given).max() <= _SAME * max(np.abs(given).max(), moving))


def typical_states(dynamics: Equations, pose: Array) -> Array:
    """Give a pose, shape (1, body + world, 13), and some beside it, of which few are singular.

    Most constraints are independent at nearly all poses.
    """
    beside = np.repeat(pose, _BESIDE, axis=0)
    random = np.random.default_rng(_SEED)
    beside[:, :-1, 7:] = random.standard_normal((_BESIDE, pose.shape[1] - 1, 6))
    ways = dynamics.closest(beside)[0][..., 7:]
    ways *= _WAY / np.maximum(_STILL, [[[_size(dynamics, way)]] for way in ways])
    moved = np.concatenate([_moved(pose[0], way[None]) for way in ways])
    for _ in range(2 * _PASSES):
        moved, _ = dynamics.closest(moved)
    met = np.abs(dynamics.residual(moved)).max(axis=1) < _MET * dynamics.length
    return np.concatenate([pose, moved[met]])


def _direction(dynamics: Equations, twist: Array, acceleration: Array) -> Array | None:
    """Twists of the motion, or of the one to come, `_size` 1, shape (body + world, 6)."""
    speed, change = _size(dynamics, twist), _size(dynamics, acceleration)
    if not 0.0 < speed + change < np.inf:
        return None
    return twist / speed if speed > _STILL * np.sqrt(change) else acceleration / change


def _size(dynamics: Equations, twist: Array) -> float:
    """Largest turn, or way over the scene's length."""
    return float(max(np.abs(twist[:, :3]).max() / dynamics.length, np.abs(twist[:, 3:]).max()))


def _moved(state: Array, way: Array) -> Array:
    new = np.repeat(state[None], len(way), axis=0)
    new[..., _X] += way[..., :3]
    new[..., _Q] = rotation.multiply(rotation.from_vector(way[..., 3:]), new[..., _Q])
    return new
