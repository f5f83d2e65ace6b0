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

__all__ = ["Hanger", "angles", "cross_axes", "slim"]

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


class Hanger:
    """Turns rods about themselves as Cardan joints on their tree parents would.

    Args:
        mechanism: Of the scene.
        axes: Unit axes in native frames, zero for bodies that stay as they are, (body, 3).
    """

    def __init__(self, mechanism: Mechanism, axes: Array) -> None:
        self._axes = axes
        self._joints = [
            (link.body, link.parent, np.stack([*rotation.normal_to(axis), axis], axis=-1))
            for link in mechanism.links
            if (axis := axes[link.body]).any()
        ]

    def hung(self, bodies: BodyStates) -> BodyStates:
        """Turn them, in states of all bodies, shape (…, body, …)."""
        turns, spin = rotation.matrix(bodies.native), bodies.angular_velocity.copy()
        points = np.einsum("...bij,bj->...bi", turns, self._axes)
        # Matrices, because this is called with a few states at a time.
        for body, above, basis in self._joints:
            held = above == WORLD_INDEX
            parent = np.eye(3) if held else turns[..., above, :, :]
            rate = np.zeros(3) if held else spin[..., above, :]
            frame, point = parent @ basis, points[..., body, :]
            aside, ahead = (np.vecdot(point, frame[..., k])[..., None] for k in (1, 2))
            cosine = np.hypot(aside, ahead)
            second = (ahead * frame[..., 1] - aside * frame[..., 2]) / cosine
            first = rotation.cross(second, point)
            turns[..., body, :, :] = np.stack([first, second, point], axis=-1) @ basis.T
            relative = spin[..., body, :] - rate
            along, across = (np.vecdot(relative, axis)[..., None] for axis in (first, second))
            spin[..., body, :] = rate + along / cosine * frame[..., 0] + across * second
        rods = self._axes.any(axis=-1, keepdims=True)
        native = np.where(rods, rotation.from_matrix(turns), bodies.native)
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
