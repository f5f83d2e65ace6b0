"""Accelerations at many states that have nothing to do with each other, eight at once."""

from __future__ import annotations

import numpy as np

from mbds_xsim.reference.closure_kernel import accelerate
from mbds_xsim.reference.lanes import LANES, entered
from mbds_xsim.reference.load_kernel import hold
from mbds_xsim.reference.noted import noted
from mbds_xsim.reference.tree import Tree
from mbds_xsim.reference.tree_kernel import PLACES, A, Workspace


@entered
def accelerate_all(t: Tree, work: Workspace, lane, loads, found):
    """Find accelerations of the bodies at many states, shape (state, body, 6).

    Args:
        t: The tree.
        work: Its arrays.
        lane: Room for a state and its rate, (number, 8) each.
        loads: States (state, number), forces (state, body, 3), torques and grips of them.
        found: Is filled in.
    """
    t, work = noted(t), noted(work)
    y, force, torque, grip = loads
    last = len(y) - 1
    for first in range(0, len(y), LANES):
        for k in range(LANES):
            row = min(first + k, last)
            for j in range(y.shape[1]):
                lane[0][j, k] = y[row, j]
            for j in range(grip.shape[1]):
                work.grip[j, k] = grip[row, j]
            hold(t, work, k, force[row], torque[row])
        accelerate(t, work, lane[0], lane[1], np.int64(0))
        for i in range(len(t.kind)):
            for j in range(6):
                for k in range(min(LANES, len(y) - first)):
                    found[first + k, t.body[i], j] = work.link[i * PLACES + A + j, k]
