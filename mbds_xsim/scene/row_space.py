"""Rows of a sparse Jacobian: an independent set, and the least change that satisfies them.

Independence is a matter of geometry alone, so it is decided without masses and with every column in
its own units: a part of 1 µm and 1e-15 kg on one of 1 m and 1 kg is held as well as the large one.
Few rows are factorised densely by orthogonal transformations, which resolve independent parts down
to 1e-9 of a row; many rows by a sparse Cholesky factorisation of J Jᵀ, which resolves 1e-6.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import SuperLU, norm, splu

from mbds_xsim.base.arrays import Array, Indices

_FEW = 400
_INDEPENDENT = 1e-9
_INDEPENDENT_SQUARED = 1e-12
_ADDED = 1e-14  # added to the diagonal: dependent rows leave this, or far smaller noise
_REFINEMENTS = 6


def independent_rows(jacobian: csr_array) -> Indices:
    """Find a maximal set of independent rows, in ascending order."""
    matrix = _even(jacobian)
    if not matrix.shape[0]:
        return np.zeros(0, dtype=np.intp)
    if matrix.shape[0] <= _FEW:
        triangle, pivot = qr(matrix.toarray().T, mode="r", pivoting=True)
        size = np.abs(np.diagonal(triangle))
        return np.sort(pivot[: len(size)][size > _INDEPENDENT * size[0]]).astype(np.intp)
    factor = _factorised(matrix, _ADDED)
    size = factor.U.diagonal()
    return np.flatnonzero(size[factor.perm_c] > _INDEPENDENT_SQUARED)


def least_change(jacobian: csr_array, root: csr_array, goal: Array) -> Array:
    """Solve jacobian · change = goal with least |root⁻¹ change|.

    If rows contradict each other, all are satisfied in the least-squares sense if there are at most
    `_FEW` rows; if there are more, an independent set is satisfied and the others are not.

    Args:
        jacobian: Matrix of the rows, shape (row, column).
        root: Symmetric root of the inverse of the weights, block-diagonal, shape (column, column).
        goal: Wanted product of each row with the change, shape (row,).
    """
    chosen = independent_rows(jacobian)
    scaled = (jacobian[chosen] @ root).tocsr()
    size = 1.0 / norm(scaled, axis=1)
    few = jacobian.shape[0] <= _FEW
    wanted = size * (_reached(jacobian, chosen, goal) if few else goal[chosen])
    scaled = diags_array(size) @ scaled
    if few:
        return np.asarray(root @ _least_dense(scaled.toarray(), wanted))
    factor = _factorised(scaled, 0.0)
    change = np.zeros(scaled.shape[1])
    # Refine the change, not the multipliers, which may be large and cancel in it.
    for _ in range(_REFINEMENTS):
        change += scaled.T @ factor.solve(wanted - scaled @ change)
    return np.asarray(root @ change)


def _reached(jacobian: csr_array, chosen: Indices, goal: Array) -> Array:
    """Return goals of the chosen rows that fit the goals of all rows by least squares."""
    if len(chosen) == jacobian.shape[0]:
        return goal
    matrix = jacobian.toarray()
    matrix /= np.maximum(np.linalg.norm(matrix, axis=0), np.finfo(np.float64).tiny)
    share = np.linalg.lstsq(matrix[chosen].T, matrix.T)[0].T
    return np.asarray(np.linalg.lstsq(share, goal)[0])


def _least_dense(matrix: Array, goal: Array) -> Array:
    if not len(goal):
        return np.zeros(matrix.shape[1])
    # Columns that masses make large come first, so that their rounding does not swamp the others.
    order = np.argsort(-np.abs(matrix).max(axis=0), kind="stable")
    basis, triangle, pivot = qr(matrix[:, order].T, mode="economic", pivoting=True)
    answer = np.zeros(matrix.shape[1])
    for _ in range(2):  # the second pass restores what rounding lost in the first
        residual = (goal - matrix @ answer)[pivot]
        answer[order] += basis @ solve_triangular(triangle, residual, trans="T")
    return answer


def _even(jacobian: csr_array) -> csr_array:
    """Scale columns, then rows, to norm 1."""
    column, matrix = norm(jacobian, axis=0), jacobian
    matrix = (matrix @ diags_array(1.0 / np.where(column > 0.0, column, 1.0))).tocsr()
    row = norm(matrix, axis=1)
    return (diags_array(1.0 / np.where(row > 0.0, row, 1.0)) @ matrix).tocsr()


def _factorised(matrix: csr_array, shift: float) -> SuperLU:
    """Factorise A Aᵀ, where A has rows of norm 1, in an order with little fill-in."""
    square = (matrix @ matrix.T + shift * eye_array(matrix.shape[0])).tocsc()
    return splu(
        square,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True, "Equil": False},
    )
