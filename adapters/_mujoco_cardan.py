"""Cardan joints in place of ball joints, for rods that never spin about themselves.

Two hinges say where such a rod points. The frames that they turn do spin about the rods, to no
effect: the model's rods have next to no inertia about themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism

__all__ = ["angles", "cross_axes", "hung", "slim", "turned"]

Array = NDArray[np.float64]

# Of the moment across; MuJoCo wants one above 1e-15 kg·m².
_SLIM = 1e-9


def cross_axes(axes: Array) -> Array:
    """Give both axes of each joint, the first of which is fixed in the parent, (…, 2, 3)."""
    return np.array([rotation.normal_to(axis) for axis in axes]).reshape(-1, 2, 3)


def slim(inertia: Array, axis: Array) -> Array:
    """Leave next to nothing of the inertia about the axis."""
    across = np.eye(3) - np.outer(axis, axis)
    moment = np.trace(across @ inertia) / 2
    return np.asarray(moment * (across + _SLIM * np.outer(axis, axis)))


def hung(mechanism: Mechanism, axes: Array, bodies: BodyStates) -> BodyStates:
    """Turn rods with an axis about that, as Cardan joints on their tree parents would.

    Args:
        mechanism: Of the scene.
        axes: Unit axes in native frames, zero for bodies that stay as they are, (body, 3).
        bodies: All bodies, shape (…, body, …).
    """
    native, spin = bodies.native.copy(), bodies.angular_velocity.copy()
    still = np.zeros_like(spin[..., 0, :])
    for link in mechanism.links:
        if not axes[link.body].any():
            continue
        if link.parent == WORLD_INDEX:
            parent, rate = np.broadcast_to(rotation.IDENTITY, (*still.shape[:-1], 4)), still
        else:
            parent, rate = native[..., link.parent, :], spin[..., link.parent, :]
        first, second = rotation.normal_to(axes[link.body])
        points = rotation.rotate(native[..., link.body, :], axes[link.body])
        there = rotation.rotate(rotation.conjugate(parent), points)
        b = np.arcsin(np.clip(there @ first, -1.0, 1.0))
        a = np.arctan2(-there @ second, there @ axes[link.body])
        native[..., link.body, :] = rotation.multiply(parent, _rotation(a, b, first, second))
        one, other = (
            rotation.rotate(parent, first),
            rotation.rotate(native[..., link.body, :], second),
        )
        relative = spin[..., link.body, :] - rate
        forward = rotation.cross(other, points)
        turning = np.sum(relative * forward, axis=-1) / np.sum(one * forward, axis=-1)
        spin[..., link.body, :] = (
            rate
            + turning[..., None] * one
            + np.sum(relative * other, axis=-1, keepdims=True) * other
        )
    return BodyStates(bodies.position, native, bodies.velocity, spin)


def angles(turn: Array, rate: Array, cross: Array) -> tuple[Array, Array]:
    """Read both angles and their rates off rods relative to their parents.

    Args:
        turn: Of the joints, child to parent, shape (…, joint, 4).
        rate: Angular velocities in the children's frames, shape (…, joint, 3).
        cross: As `cross_axes` gives them.

    Returns:
        Angles and rates, shape (…, joint, 2).
    """
    along = np.einsum("...ji,jki->...jk", turn[..., 1:], cross)
    both = 2.0 * np.arctan2(along, turn[..., :1])
    rates = np.einsum("...ji,jki->...jk", rate, cross)
    rates[..., 0] /= np.cos(both[..., 1])
    return both, rates


def turned(both: Array, rates: Array, cross: Array) -> tuple[Array, Array]:
    """Give what `angles` takes."""
    a, b = both[..., 0], both[..., 1]
    first, second = cross[:, 0], cross[:, 1]
    axis = np.cross(first, second)
    da, db = rates[..., :1], rates[..., 1:]
    b_ = b[..., None]
    rate = da * (np.cos(b_) * first + np.sin(b_) * axis) + db * second
    return _rotation(a, b, first, second), rate


def _rotation(a: Array, b: Array, first: Array, second: Array) -> Array:
    return rotation.multiply(
        rotation.from_vector(a[..., None] * first), rotation.from_vector(b[..., None] * second)
    )
