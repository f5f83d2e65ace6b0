"""Rows that make joints' rates of the bodies' twists, and couplings of these."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def rate_row(mechanism: Mechanism, joint: PlacedJoint, position: Array, native: Array) -> csr_array:
    """Give the row that makes a hinge's or slider's rate of the twists, shape (1, 6 · body)."""
    from scipy.sparse import csr_array

    held = joint.parent == WORLD_INDEX
    axis = joint.axis if held else rotation.rotate(native[joint.parent], joint.axis)
    # What either is of the world is left out below.
    if joint.kind == "hinge":
        child, parent = [0.0, 0.0, 0.0, *axis], [0.0, 0.0, 0.0, *-axis]
    else:
        anchor = joint.in_child
        if joint.child != WORLD_INDEX:
            anchor = position[joint.child] + rotation.rotate(native[joint.child], joint.in_child)
        child = [*axis, *np.cross(anchor - position[joint.child], axis)]
        parent = [*-axis, *-np.cross(anchor - position[joint.parent], axis)]
    ends = [(joint.child, child), (joint.parent, parent)]
    values = np.array([block for body, block in ends if body != WORLD_INDEX]).reshape(-1)
    columns = [6 * body + k for body, _ in ends if body != WORLD_INDEX for k in range(6)]
    shape = (1, 6 * mechanism.body_count)
    return csr_array((values, ([0] * len(columns), columns)), shape=shape)


def coupling_rows(mechanism: Mechanism, position: Array, native: Array) -> list[csr_array]:
    """Give, for each coupling, the row whose product with the twists is 0, shape (1, 6 · body)."""

    def row(joint: PlacedJoint) -> csr_array:
        return rate_row(mechanism, joint, position, native)

    return [row(each.follower) - each.ratio * row(each.leader) for each in mechanism.couplings]
