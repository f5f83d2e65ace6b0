"""Brakes of joints, which are dry friction and stops, and the share of each that acts.

Each brake acts on one coordinate, so all that hold something at rest are columns of one problem:
find the shares μ that minimise ½ μᵀ H μ − aᵀ μ. Here a are the accelerations without the brakes
and H their reduction by the brakes, both times the sizes of the brakes. Shares of friction are
within ±1; those of stops are 0 or more, as a stop only pushes. In an impact the same holds for
velocities and the impulses of stops (Moreau, J. J., Unilateral contact and dry friction in finite
freedom dynamics, 1988): as every joint that touches a stop approaches it, no energy is gained.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.reference.tree import Tree, link_number
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint

_NULL = 1e-12  # of H's largest eigenvalue: a direction below it moves nothing


@dataclass(frozen=True, eq=False)
class Brakes:
    """Frictions of joints, then lower stops, then upper stops; arrays have the shape (brake,)."""

    joints: tuple[PlacedJoint, ...]
    law: Index
    """Index in the tree of each joint's law."""
    fast: Index
    """Index in a state of each joint's rate."""
    place: Index
    """Index in a state of each joint's coordinate."""
    turn: Array
    """Sign of the rate that runs into a stop; 1 for friction."""
    size: Array
    """Friction [N·m or N]; 1 for stops."""
    least: Array
    most: Array
    """Upper bounds of the shares; `least` has the lower ones."""
    bound: Array
    """Coordinates of stops; 0 for friction."""
    restitution: Array

    @staticmethod
    def of(tree: Tree, spanned: Mechanism) -> Brakes:
        """Lay out the brakes of a mechanism with this tree."""
        rough, limited = spanned.frictional, spanned.limited
        count, joints = len(rough), (*rough, *limited, *limited)
        law = [spanned.counted.index(joint) for joint in joints]
        link = [link_number(spanned, joint) for joint in joints]
        angle = tree.angle_at[law]
        low, high = np.array([joint.limits for joint in limited]).reshape(-1, 2).T
        none, stops = np.zeros(count), np.ones(len(low))
        return Brakes(
            joints=joints,
            law=np.array(law, dtype=np.int64),
            fast=tree.speed_at[link],
            place=np.where(angle >= 0, angle, tree.at[link]),
            turn=np.concatenate([none + 1.0, -stops, stops]),
            size=np.array([joint.friction for joint in rough] + 2 * len(low) * [1.0]),
            least=np.concatenate([none - 1.0, 0.0 * stops, 0.0 * stops]),
            most=np.concatenate([none + 1.0, np.inf * stops, np.inf * stops]),
            bound=np.concatenate([none, low, high]),
            restitution=np.array([joint.restitution for joint in joints]),
        )

    @property
    def stops(self) -> Mask:
        """Mask of the brakes that are stops."""
        return np.isinf(self.most)

    def gaps(self, y: Array) -> Array:
        """Return the distances of coordinates from stops, infinite for friction, shape (brake,)."""
        return np.where(self.stops, self.turn * (self.bound - y[self.place]), np.inf)

    def approach(self, y: Array) -> Array:
        """Return the rates towards stops, and those of joints with friction, shape (brake,)."""
        return np.asarray(self.turn * y[self.fast])


def least_shares(free: Array, reduction: Array, least: Array, most: Array) -> Array:
    """Find the shares μ that minimise ½ μᵀ H μ − aᵀ μ within their bounds.

    Args:
        free: Accelerations a without the brakes that hold, times their sizes, shape (holding,).
        reduction: Symmetric matrix H: what each share takes from them, shape (holding, holding).
        least: Lower bounds of the shares.
        most: Upper bounds of the shares.
    """
    from scipy.optimize import lsq_linear  # takes long to import

    scale = np.sqrt(np.maximum(np.diag(reduction), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(reduction / np.outer(scale, scale))
    kept = values > _NULL * values.max()
    roots, basis = np.sqrt(values[kept]), vectors[:, kept]
    solution = lsq_linear(
        roots[:, None] * basis.T,
        basis.T @ (free / scale) / roots,
        (least * scale, most * scale),
        method="bvls",
    )
    return np.asarray(solution.x / scale)
