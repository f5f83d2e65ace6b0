"""What holds joints: dry friction and stops, and how much of each a motion takes.

Both act on a coordinate alone, so that they are columns of one problem: of what stands still,
shares μ that make ½ μᵀ H μ − aᵀ μ least, a the accelerations without them and H what they take of
these, both times the sizes of the brakes. Shares of friction are within ±1, those of stops 0 or
more, as a stop only pushes. In an impact the same holds of velocities and of stops' impulses
(Moreau, J. J., Unilateral contact and dry friction in finite freedom dynamics, 1988): as all that
touches approaches, no energy comes of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.reference.tree import Tree, link_number
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint

_LOST = 1e-12  # of H's largest eigenvalue: what moves nothing


@dataclass(frozen=True, eq=False)
class Brakes:
    """Frictions of joints, then their stops, lower and upper; arrays of shape (brake,)."""

    joints: tuple[PlacedJoint, ...]
    law: Index
    """Their laws in the tree."""
    fast: Index
    """Where the rates of their joints stand in a state."""
    place: Index
    """Where the coordinates stand."""
    turn: Array
    """1 of friction; of stops the sense of the coordinate that runs into them."""
    size: Array
    """Friction [N·m or N]; of stops 1."""
    least: Array
    most: Array
    """Bounds of the shares."""
    bound: Array
    """Coordinates of stops; of friction 0."""
    restitution: Array

    @staticmethod
    def of(tree: Tree, spanned: Mechanism) -> Brakes:
        """Lay them out."""
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
        """Tell which are stops."""
        return np.isinf(self.most)

    def gaps(self, y: Array) -> Array:
        """Give how far coordinates are from their stops, infinite of friction, shape (brake,)."""
        return np.where(self.stops, self.turn * (self.bound - y[self.place]), np.inf)

    def approach(self, y: Array) -> Array:
        """Give the rates towards stops, and those of joints with friction, shape (brake,)."""
        return np.asarray(self.turn * y[self.fast])


def least_shares(free: Array, taken: Array, least: Array, most: Array) -> Array:
    """Solve the problem above.

    Args:
        free: Accelerations of what is held, without it, times the brakes' sizes, shape (held,).
        taken: What each share takes of them, shape (held, held), symmetric.
        least: Bounds of the shares.
        most: Likewise.
    """
    from scipy.optimize import lsq_linear  # takes long to import

    scale = np.sqrt(np.maximum(np.diag(taken), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(taken / np.outer(scale, scale))
    kept = values > _LOST * values.max()
    roots, basis = np.sqrt(values[kept]), vectors[:, kept]
    found = lsq_linear(
        roots[:, None] * basis.T,
        basis.T @ (free / scale) / roots,
        (least * scale, most * scale),
        method="bvls",
    )
    return np.asarray(found.x / scale)
