"""Solve A λ = b with A = J M⁻¹ Jᵀ, using that a row meets only the rows that share a body.

With rows ordered by reverse Cuthill–McKee, A is a narrow band and Cholesky's method costs
O(rows · bandwidth²). Where rows depend on one another (over-constrained or singular mechanisms) a
pivoted Cholesky factorisation picks an independent set and leaves the others unloaded: the
multipliers are then not unique, but the motion is.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from mbds_xsim.reference.topology import Topology

__all__ = ["Multipliers", "multipliers_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# A row whose part independent of the others is below this share of it (squared) is taken as
# dependent. Rounding leaves 1e-13 there; in regular mechanisms the least is about a ratio of
# masses. Much nearer to a singular pose it is not the mechanism that decides where the motion goes,
# but the 1e-13 by which its constraints are violated: at 1e-11 a third of the motions ended there.
_DEPENDENT = 1e-9


@functools.lru_cache(maxsize=64)
def multipliers_of(topology: Topology) -> Multipliers:
    """Find the order and the band of a topology (once each)."""
    return Multipliers(topology)


class Multipliers:
    """Structure of A for one topology.

    Each body has *slots*, one for every row that touches it (the last body, the world, has only
    empty ones). The scaled Jacobian is given slot by slot, shape (batch, body + world, slot, 6);
    `slot_half` says which half-row (end · (row + 1) + row; index `row` is empty) fills each.
    """

    slot_half: Indices
    """Shape (body + world, slot)."""
    slot_row: Indices
    """Row of each slot, 0 for empty ones, shape (body + world, slot)."""
    row_slot: Indices
    """Flat slots of the two ends of each row, shape (2, row)."""

    def __init__(self, topology: Topology) -> None:
        rows, world = topology.row_count, topology.body_count
        touching: list[list[tuple[int, int]]] = [[] for _ in range(world)]
        for end in (0, 1):
            for row, body in enumerate(topology.row_body[end]):
                if body != world:
                    touching[body].append((end, row))
        self.row_count = rows
        self.slot_count = max([1, *(len(slots) for slots in touching)])
        shape = (world + 1, self.slot_count)
        self.slot_half = np.full(shape, rows, dtype=np.intp)
        self.slot_row = np.zeros(shape, dtype=np.intp)
        self.row_slot = np.full((2, rows), world * self.slot_count, dtype=np.intp)
        for body, slots in enumerate(touching):
            for k, (end, row) in enumerate(slots):
                self.slot_half[body, k] = end * (rows + 1) + row
                self.slot_row[body, k] = row
                self.row_slot[end, row] = body * self.slot_count + k
        if rows:
            self._order(touching)

    def _order(self, touching: list[list[tuple[int, int]]]) -> None:
        """Find the row order and, for each element of the band, the products that make it."""
        rows, slots = self.row_count, self.slot_count
        near = np.zeros((rows, rows), dtype=bool)
        for group in touching:
            members = [row for _, row in group]
            near[np.ix_(members, members)] = True
        self._row_at = reverse_cuthill_mckee(csr_array(near), symmetric_mode=True).astype(np.intp)
        place = np.argsort(self._row_at)
        first, second = np.nonzero(near)
        self._band = int(np.abs(place[first] - place[second]).max(initial=0))
        empty = len(touching) * slots * slots
        # Two rows share at most two bodies, so an element is a sum of at most two products.
        self._source = np.full((2, rows, self._band + 1), empty, dtype=np.intp)
        used = np.zeros((rows, self._band + 1), dtype=np.intp)
        for body, group in enumerate(touching):
            for a, (_, row_a) in enumerate(group):
                for b, (_, row_b) in enumerate(group):
                    column, below = int(place[row_b]), int(place[row_a] - place[row_b])
                    if below >= 0:
                        layer = int(used[column, below])
                        self._source[layer, column, below] = (body * slots + a) * slots + b
                        used[column, below] += 1

    def solve(self, jacobian: Array, goal: Array) -> Array:
        """Multipliers, shape (batch, row), of the right-hand sides `goal`, shape (batch, row)."""
        products = np.matmul(jacobian, jacobian.swapaxes(-1, -2)).reshape(len(jacobian), -1)
        band = products[:, self._source[0]]
        band += products[:, self._source[1]]
        diagonal = band[:, :, 0].copy()
        pivot = np.empty_like(diagonal)
        answer = goal[:, self._row_at]
        regular = np.ones(len(goal), dtype=bool)
        for k in range(len(goal)):
            factor, x, info = lapack.dpbsv(band[k].T, answer[k], lower=1, overwrite_ab=1)
            regular[k] = info == 0
            pivot[k], answer[k] = factor[0], x
        regular &= (pivot**2 > _DEPENDENT * diagonal).all(axis=1)
        for row in np.flatnonzero(~regular):
            answer[row] = self._solve_dependent(products[row], goal[row, self._row_at])
        multipliers = np.empty_like(answer)
        multipliers[:, self._row_at] = answer
        return multipliers

    def _solve_dependent(self, products: Array, goal: Array) -> Array:
        rows = self.row_count
        lower = np.zeros((rows, rows + self._band))
        column = np.arange(rows)[:, None]
        lower[column, column + np.arange(self._band + 1)] = products[self._source].sum(axis=0)
        # `lower` holds columns; each is scaled so that the pivots are shares of their rows.
        scale = 1.0 / np.sqrt(lower[np.arange(rows), np.arange(rows)])
        matrix = (lower[:, :rows] * scale * scale[:, None]).T
        factor, pivot, rank, _ = lapack.dpstrf(matrix, tol=_DEPENDENT, lower=1)
        chosen = pivot[:rank] - 1
        part, _ = lapack.dpotrs(factor[:rank, :rank], (scale * goal)[chosen], lower=1)
        answer = np.zeros(rows)
        answer[chosen] = part * scale[chosen]
        return answer
