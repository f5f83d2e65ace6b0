"""March a batch as `marching` does, but with compiled, much faster kernels (`benchmarks.frontier`).

Every trajectory that they cannot finish (at singular poses, or where steps become too small) is
marched again by `marching`, which finds a way on or reports why there is none.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.reference import dop853, march_kernel, marching
from mbds_xsim.reference.dynamics import maximal_of, pose_of
from mbds_xsim.reference.elimination import with_short_loops
from mbds_xsim.reference.lanes import LANES
from mbds_xsim.reference.march_kernel import BLOCK, Lane, Problems, Scheme
from mbds_xsim.reference.marching import Marched, Problem
from mbds_xsim.reference.multipliers import POOR
from mbds_xsim.reference.row_kernel import ROW
from mbds_xsim.reference.singular import typical_states
from mbds_xsim.reference.tree import (
    BALL,
    COUPLED,
    FREE,
    Tree,
    link_number,
    to_tree,
    tree_of,
    with_rows,
)
from mbds_xsim.reference.tree_kernel import PLACES, R, V, W, Workspace, X
from mbds_xsim.scene.mechanism import Mechanism

_FEWER = 0.1
_DEPENDENT = 1e-9
_REPEATED = 1e-16
"""Largest share of a row that only repeats what the tree holds: rounding leaves 1e-31, gaps of 1e-9
leave 1e-18; rows that hold a very light body may have little more."""

_ROWS = np.array([*dop853.A, dop853.B, dop853.E5, dop853.E3])
_NO_SCHEME = Scheme(
    begin=np.searchsorted(np.nonzero(_ROWS)[0], np.arange(len(_ROWS) + 1)),
    stage=np.nonzero(_ROWS)[1],
    weight=_ROWS[np.nonzero(_ROWS)],
)
_NO_TASK = Problems(
    start=np.zeros((0, 0)),
    force=np.zeros((0, 0, 0, 3)),
    torque=np.zeros((0, 0, 0)),
    frame=0.0,
    states=np.zeros((0, 0, 0, 13)),
    status=np.zeros(0, dtype=np.int64),
)


def march_compiled(problem: Problem) -> Marched:
    """Integrate states frame by frame."""
    start, marched = problem.start, Marched.from_start(problem)
    if not (problem.frames and len(start)):
        return marched
    tree, spanned, near = chosen(problem.mechanism)
    task = Problems(
        to_tree(spanned, problem.dynamics.unpack(start), start),
        np.require(problem.force, float, ["C", "W"]),
        np.require(problem.torque, float, ["C", "W"]),
        problem.frame,
        marched.states,
        np.zeros(len(start), dtype=np.int64),
    )
    Kernel(tree).run(march_kernel.MARCH, task, _scheme(problem, near))
    _keep_signs(tree, marched.states, start)
    lost = np.flatnonzero(task.status != march_kernel.REACHED)
    if len(lost):
        slow = marching.march(problem.part(lost))
        marched.states[lost] = slow.states
        for row, failure in zip(lost.tolist(), slow.failures, strict=True):
            marched.failures[row] = failure
    return marched


def body_accelerations(mechanism: Mechanism, states: Array, force: Array, torque: Array) -> Array:
    """Evaluate the equations of motion at states of the reference.

    Only joints that move have dry friction here; joints at rest have none.

    Returns:
        Accelerations of the centres of mass [m/s²], then angular accelerations [rad/s²], in W,
        shape (batch, body, 6).
    """
    tree, spanned, _ = chosen(mechanism)
    y = to_tree(spanned, maximal_of(mechanism).unpack(states), states)
    accelerations = np.empty((len(states), 1, mechanism.body_count, 6))
    grip = np.zeros((len(states), len(tree.law)))
    for joint in spanned.frictional:
        rate = y[:, tree.speed_at[link_number(spanned, joint)]]
        grip[:, spanned.counted.index(joint)] = joint.friction * np.sign(rate)
    force, torque = (np.require(load[:, None], float, ["C", "W"]) for load in (force, torque))
    task = Problems(y, force, torque, 0.0, accelerations, np.zeros(0, dtype=np.int64), grip)
    Kernel(tree).run(march_kernel.EVALUATE, task)
    return accelerations[:, 0]


def projected(mechanism: Mechanism, states: Array) -> Array:
    """Project states of the reference onto the closures by least mass-weighted changes."""
    tree, spanned, _ = chosen(mechanism)
    kernel, projections = Kernel(tree), states.copy()
    coordinates = to_tree(spanned, maximal_of(mechanism).unpack(states), states)
    for rows, y in _in_lanes(coordinates):
        for k, place in enumerate(tree.row.place[:, 0]):
            if tree.row.kind[k] == COUPLED and place in tree.angle_at:
                wanted = tree.row.length[k] - tree.row.way[k, 1] * y[tree.row.place[k, 1]]
                y[place] += 2 * np.pi * np.round((wanted - y[place]) / (2 * np.pi))
        kernel.y[:] = y
        kernel.run(march_kernel.PROJECT)
        projections[rows] = kernel.body_states()
    return with_signs_of(projections, states)


class Kernel:
    """The compiled kernel, for one tree."""

    def __init__(self, tree: Tree) -> None:
        self.tree, self.work = tree, _workspace(tree)
        self._lane = _lane(tree)
        self.y, self.rates = self._lane.y[: tree.size], self._lane.stages[: tree.size]
        """States of eight lanes and their rates, shape (number, 8)."""

    def run(self, operation: int, task: Problems = _NO_TASK, scheme: Scheme = _NO_SCHEME) -> None:
        """Run one of the operations of `march_kernel`."""
        march_kernel.run(operation, self.tree, self.work, scheme, self._lane, task)

    def body_states(self) -> Array:
        """Return the lanes' states in the reference's layout, shape (lane, body + world, 13)."""
        self.run(march_kernel.MOVE)
        link = np.moveaxis(self.work.link.reshape(-1, PLACES, LANES)[:-1], -1, 0)
        turn = rotation.from_matrix(link[..., R : R + 9].reshape(*link.shape[:-1], 3, 3))
        parts = (link[..., X : X + 3], turn, link[..., V : V + 3], link[..., W : W + 3])
        states = np.zeros((LANES, len(self.tree.kind) + 1, 13))
        states[:, -1, 3] = 1.0
        states[:, self.tree.body] = np.concatenate(parts, axis=-1)
        return states


def with_signs_of(states: Array, others: Array) -> Array:
    """Choose the signs of quaternions to match those of other states."""
    along = np.sum(states[..., 3:7] * others[..., 3:7], axis=-1, keepdims=True)
    states[..., 3:7] *= np.where(along < 0.0, -1.0, 1.0)
    return states


def _in_lanes(y: Array) -> Iterator[tuple[Index, Array]]:
    """Yield the numbers of eight states, the last one repeated if need be, and these as lanes."""
    for first in range(0, len(y), LANES):
        rows = np.minimum(np.arange(first, first + LANES), len(y) - 1)
        yield rows, np.ascontiguousarray(y[rows].T)


def _resisting(tree: Tree, y: Array) -> Iterator[tuple[Index, Workspace]]:
    """Eliminate the rows, eight states at a time; yield the states' numbers and the workspace."""
    kernel = Kernel(tree)
    for rows, kernel.y[:] in _in_lanes(y):
        kernel.run(march_kernel.RESIST)
        yield rows, kernel.work


@functools.lru_cache(maxsize=64)
def chosen(mechanism: Mechanism) -> tuple[Tree, Mechanism, float]:
    """Choose the tree with the cheapest loops, and independent rows in it to carry loads.

    Returns:
        The tree, the mechanism that has it, and the independent share of a row below which a pose
        may be singular.
    """
    spanned, dynamics = with_short_loops(mechanism), maximal_of(mechanism)
    tree = tree_of(spanned)
    if not tree.loaded:
        return tree, spanned, 0.0
    states = typical_states(dynamics, dynamics.pack(pose_of(mechanism)))
    y, count = to_tree(spanned, dynamics.unpack(states), states), tree.loaded
    matrix, (row, column) = np.zeros((len(y), count, count)), tree.plan.pair_row.T
    sizes = np.empty((len(y), count))
    for numbers, work in _resisting(tree, y):
        sizes[numbers] = work.rows[14 : ROW * count : ROW].T
        matrix[numbers[:, None], row, column] = work.couplings.T
    choices = [_pivoted(*pair) for pair in zip(matrix, sizes, strict=True)]
    rows, _ = max(choices, key=lambda each: (len(each[0]), each[1]))
    left_out = np.setdiff1d(np.arange(tree.loaded), rows)
    tree = with_rows(tree, np.concatenate([rows, left_out]), len(rows))
    usual = max(float(work.share[0].max()) for _, work in _resisting(tree, y))
    return tree, spanned, min(POOR, _FEWER * usual)


def _pivoted(matrix: Array, size: Array) -> tuple[Array, float]:
    """Return the independent rows, and the least independent share of one, squared."""
    from scipy.linalg import lapack  # takes long to import

    if (np.diag(matrix) / size).max() <= _REPEATED:
        return np.zeros(0, dtype=int), 1.0  # the factorisation would always keep one row
    scale = 1.0 / np.sqrt(size)
    factor, pivot, rank, _ = lapack.dpstrf(matrix * scale * scale[:, None], tol=_DEPENDENT, lower=1)
    return pivot[:rank] - 1, float(factor[rank - 1, rank - 1] ** 2)


def _keep_signs(tree: Tree, states: Array, start: Array) -> None:
    """Match the signs of quaternions that follow from other bodies' to those of the start."""
    bodies = tree.body[(tree.kind != BALL) & (tree.kind != FREE)]
    if len(bodies):
        along = np.sum(states[:, 0, bodies, 3:7] * start[:, bodies, 3:7], axis=-1)
        for row, k in np.argwhere(along < 0.0).tolist():
            states[row, :, bodies[k], 3:7] *= -1.0
    states[:, 0] = start


def _workspace(tree: Tree) -> Workspace:
    """Create the arrays that the kernels of a tree need."""
    links, rows, loaded, plan = len(tree.kind) + 1, len(tree.row.kind), tree.loaded, tree.plan
    work = Workspace(
        link=lines(links * PLACES),
        own=lines(tree.size),
        load=lines(6 * links),
        torque=lines(len(tree.hinge_axis) + int(np.sum(tree.pushed >= 0))),
        grip=lines(len(tree.law)),
        rows=lines(ROW * rows),
        loads=lines(12 * loaded),
        goals=lines(loaded),
        through=lines(6 * int(np.diff(plan.on_start).max(initial=0))),
        response=lines(plan.speed_count),
        couplings=lines(len(plan.pair_row)),
        multipliers=lines(loaded),
        share=lines(2),
    )
    work.share[0] = 1.0
    world = (links - 1) * PLACES + R
    work.link[world : world + 9] = np.eye(3).reshape(9, 1)
    return work


def _lane(tree: Tree) -> Lane:
    # At least one block, which is written to even if nothing can move.
    size, idle = max(1, -(-tree.size // BLOCK)) * BLOCK, lines(1)
    idle[:] = -1.0
    return Lane(
        row=np.zeros(LANES, dtype=np.int64),
        at=np.zeros(LANES, dtype=np.int64),
        remaining=np.zeros(LANES),
        step=np.zeros(LANES),
        tries=np.zeros(LANES, dtype=np.int64),
        due=np.zeros(LANES, dtype=np.bool_),
        h=idle,
        ratio=lines(3),
        worst=lines(2),
        y=lines(size),
        new=lines(size),
        stages=lines(12 * size),
    )


def lines(count: int) -> Array:
    """Create zeros of shape (count, 8), or (1, 8), with each row one line of the cache."""
    raw = np.zeros((count + 2) * LANES)
    first = -raw.ctypes.data % 64 // raw.itemsize
    return raw[first : first + max(count, 1) * LANES].reshape(-1, LANES)


def _scheme(problem: Problem, near: float) -> Scheme:
    return _NO_SCHEME._replace(
        rtol=problem.rtol,
        first=marching.FIRST_STEP * problem.frame,
        smallest=marching.SMALLEST_STEP * problem.frame,
        most=marching.MOST_STEPS,
        companions=problem.companions,
        near=near,
    )
