"""Solve A λ = b with A = J M⁻¹ Jᵀ, using that rows are coupled only if they share a body.

With rows ordered by reverse Cuthill–McKee, A is a narrow band and Cholesky's method costs
O(rows · bandwidth²). Where rows depend on one another (over-constrained mechanisms) a pivoted
Cholesky factorisation picks an independent set once, and the others stay unloaded: the multipliers
are then not unique, but the motion is. A pose at which that set loses rank is factorised anew.
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array, Indices, Mask
from mbds_xsim.reference.topology import Topology

# A row counts as dependent if the part of it that is independent of the others is below this share
# (squared). Rounding leaves 1e-13; in regular mechanisms the least share is about a ratio of
# masses. Much nearer to a singular pose the direction of the motion depends, not on the mechanism,
# but on the 1e-13 by which constraints are violated: at 1e-11 a third of the motions ended there.
_DEPENDENT = 1e-9
POOR = 2e-4
"""Share below which independent rows are chosen anew, and a pose may be singular."""


class Multipliers:
    """Structure of A for one topology.

    Each body has *slots*, one for every row that touches it (the last body, the world, has only
    empty ones). The scaled Jacobian is given slot by slot, shape (batch, body + world, slot, 6);
    `slot_half` says which half-row (end · (row + 1) + row; index `row` is empty) fills each.
    """

    slot_half: Indices
    """Half-row of each slot, shape (body + world, slot)."""
    slot_row: Indices
    """Row of each slot, 0 for empty ones, shape (body + world, slot)."""
    row_slot: Indices
    """Flat slots of the two ends of each row, shape (2, row)."""

    def __init__(self, topology: Topology) -> None:
        layout, world = topology.layout, topology.body_count
        rows = layout.row_count
        touching: list[list[tuple[int, int]]] = [[] for _ in range(world)]
        for end in (0, 1):
            for row, body in enumerate(layout.row_body[end]):
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
            self._load(np.ones(rows, dtype=bool))

    def _order(self, touching: list[list[tuple[int, int]]]) -> None:
        """Find the row order and, for each element of the band, the products that make it."""
        from scipy.sparse import csr_array  # takes long to import
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        rows, slots = self.row_count, self.slot_count
        near = np.zeros((rows, rows), dtype=bool)
        for group in touching:
            members = [row for _, row in group]
            near[np.ix_(members, members)] = True
        self._row_at = reverse_cuthill_mckee(csr_array(near), symmetric_mode=True).astype(np.intp)
        place = np.argsort(self._row_at)
        first, second = np.nonzero(near)
        self._band = int(np.abs(place[first] - place[second]).max(initial=0))
        self._empty = len(touching) * slots * slots
        # Two rows share at most two bodies, so an element is a sum of at most two products.
        self._every = np.full((2, rows, self._band + 1), self._empty, dtype=np.intp)
        used = np.zeros((rows, self._band + 1), dtype=np.intp)
        for body, group in enumerate(touching):
            for a, (_, row_a) in enumerate(group):
                for b, (_, row_b) in enumerate(group):
                    column, below = int(place[row_b]), int(place[row_a] - place[row_b])
                    if below >= 0:
                        layer = int(used[column, below])
                        self._every[layer, column, below] = (body * slots + a) * slots + b
                        used[column, below] += 1

    def choose(self, jacobian: Array) -> float:
        """Load only independent rows from now on, chosen at the state that has most of them.

        Args:
            jacobian: Scaled Jacobian of some states, shape (batch, body + world, slot, 6).

        Returns:
            Independent share of these rows at that state, as in `solve`.
        """
        factors = [self._factorised(products) for products in _products(jacobian)]
        factor, chosen, _ = max(factors, key=lambda each: (len(each[1]), each[0][-1, -1]))
        loaded = np.zeros(self.row_count, dtype=bool)
        loaded[chosen] = True
        self._load(loaded)
        return float(factor[-1, -1] ** 2)

    def _load(self, loaded: Mask) -> None:
        column = np.arange(self.row_count)[:, None]
        row = np.minimum(column + np.arange(self._band + 1), self.row_count - 1)
        self._loaded = loaded
        self._source = np.where(loaded[column] & loaded[row], self._every, self._empty)
        self.left_out = self._row_at[~loaded]

    def solve(self, jacobian: Array, goal: Array) -> tuple[Array, Array]:
        """Find the multipliers of right-hand sides.

        Args:
            jacobian: Scaled Jacobian, slot by slot, shape (batch, body + world, slot, 6).
            goal: Right-hand sides, shape (batch, row).

        Returns:
            Multipliers, shape (batch, row), and for each state the least part of a row that is
            independent of the others, as a share of the row, squared, shape (batch,): 0 where
            fewer rows are independent than elsewhere.
        """
        from scipy.linalg import lapack

        products = _products(jacobian)
        band = products[:, self._source[0]]
        band += products[:, self._source[1]]
        band[:, ~self._loaded, 0] = 1.0
        diagonal = band[:, :, 0].copy()
        pivot = np.zeros_like(diagonal)
        answer = np.where(self._loaded, goal[:, self._row_at], 0.0)
        for k in range(len(goal)):
            factor, x, info = lapack.dpbsv(band[k].T, answer[k], lower=1, overwrite_ab=1)
            if info == 0:
                pivot[k], answer[k] = factor[0], x
        share = (pivot**2 / diagonal).min(axis=1)
        multipliers = np.empty_like(answer)
        multipliers[:, self._row_at] = answer
        # Rows that are independent at most poses may be dependent at some.
        poor = POOR if len(self.left_out) else _DEPENDENT
        for k in np.flatnonzero(~(share > poor)).tolist():
            multipliers[k], share[k] = self.solve_anew(jacobian[k], goal[k])
        return multipliers, share

    def solve_anew(self, jacobian: Array, goal: Array) -> tuple[Array, float]:
        """Solve for one state, with rows that are independent there."""
        from scipy.linalg import lapack

        if not (np.isfinite(jacobian).all() and np.isfinite(goal).all()):
            return np.full(self.row_count, np.nan), 0.0  # not finite: LAPACK would find no rank
        factor, chosen, scale = self._factorised(_products(jacobian[None])[0])
        part, _ = lapack.dpotrs(factor, (scale * goal[self._row_at])[chosen], lower=1)
        answer = np.zeros(self.row_count)
        answer[self._row_at[chosen]] = part * scale[chosen]
        lost = len(chosen) < np.count_nonzero(self._loaded)
        return answer, 0.0 if lost else float(factor[-1, -1] ** 2)

    def _factorised(self, products: Array) -> tuple[Array, Indices, Array]:
        """Pivoted Cholesky factor of one state, the rows in it, and the scale of all rows."""
        from scipy.linalg import lapack

        rows = self.row_count
        lower = np.zeros((rows, rows + self._band))
        column = np.arange(rows)[:, None]
        lower[column, column + np.arange(self._band + 1)] = products[self._every].sum(axis=0)
        # `lower` holds columns; each is scaled so that the pivots are shares of their rows.
        scale = 1.0 / np.sqrt(lower[np.arange(rows), np.arange(rows)])
        matrix = (lower[:, :rows] * scale * scale[:, None]).T
        factor, pivot, rank, _ = lapack.dpstrf(matrix, tol=_DEPENDENT, lower=1)
        return factor[:rank, :rank], pivot[:rank] - 1, scale


def _products(jacobian: Array) -> Array:
    """Products of the half-rows of each body, shape (batch, body · slot · slot)."""
    return np.matmul(jacobian, jacobian.swapaxes(-1, -2)).reshape(len(jacobian), -1)
