"""Rows of a sparse Jacobian: which are independent, and the least change that fulfils them.

What is independent is a matter of geometry alone, so it is decided without masses and with every
column in units of its own: a part of 1 µm and 1e-15 kg on one of 1 m and 1 kg is held as well as
that. Few rows are factorised densely by orthogonal transformations, which see independent parts
down to 1e-9 of a row; many of them by a sparse Cholesky factorisation of J Jᵀ, which sees 1e-6.
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
_ADDED = 1e-14  # to the diagonal: dependent rows leave this, or noise far below it
_REFINEMENTS = 6


def independent_rows(jacobian: csr_array) -> Indices:
    """Find rows that are independent and on which all others depend, in ascending order."""
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

    Where rows contradict each other, few of them are fulfilled in the least squares sense; of
    many, independent ones are fulfilled and the others are not.

    Args:
        jacobian: Shape (row, column).
        root: Symmetric root of the inverse of the weights, block-diagonal, shape (column, column).
        goal: Shape (row,).
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
    # The change is made better, not the multipliers, which may be large and cancel in it.
    for _ in range(_REFINEMENTS):
        change += scaled.T @ factor.solve(wanted - scaled @ change)
    return np.asarray(root @ change)


def _reached(jacobian: csr_array, chosen: Indices, goal: Array) -> Array:
    """Give goals of the chosen rows from which all rows are off their own by the least squares."""
    if len(chosen) == jacobian.shape[0]:
        return goal
    matrix = jacobian.toarray()
    matrix /= np.maximum(np.linalg.norm(matrix, axis=0), np.finfo(np.float64).tiny)
    share = np.linalg.lstsq(matrix[chosen].T, matrix.T)[0].T
    return np.asarray(np.linalg.lstsq(share, goal)[0])


def _least_dense(matrix: Array, goal: Array) -> Array:
    if not len(goal):
        return np.zeros(matrix.shape[1])
    # Columns that masses make large come first: so no rounding error of theirs drowns the others.
    order = np.argsort(-np.abs(matrix).max(axis=0), kind="stable")
    basis, triangle, pivot = qr(matrix[:, order].T, mode="economic", pivoting=True)
    answer = np.zeros(matrix.shape[1])
    for _ in range(2):  # the second time for what the first has lost by rounding
        left = (goal - matrix @ answer)[pivot]
        answer[order] += basis @ solve_triangular(triangle, left, trans="T")
    return answer


def _even(jacobian: csr_array) -> csr_array:
    """Columns, then rows of norm 1."""
    column, matrix = norm(jacobian, axis=0), jacobian
    matrix = (matrix @ diags_array(1.0 / np.where(column > 0.0, column, 1.0))).tocsr()
    row = norm(matrix, axis=1)
    return (diags_array(1.0 / np.where(row > 0.0, row, 1.0)) @ matrix).tocsr()


def _factorised(matrix: csr_array, added: float) -> SuperLU:
    """Factorise A Aᵀ, of rows of norm 1, in an order that fills in little."""
    square = (matrix @ matrix.T + added * eye_array(matrix.shape[0])).tocsc()
    return splu(
        square,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True, "Equil": False},
    )
