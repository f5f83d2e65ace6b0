"""Vectors and matrices in space for compiled kernels; each element is eight trajectories' numbers.

Vectors are tuples of three, symmetric matrices of six (xx, yy, zz, xy, xz, yz), other matrices of
nine, row by row, quaternions of four (wxyz). `store` writes any of them.
"""

from __future__ import annotations

from mbds_xsim.reference.traced import load, store, traced


@traced
def load3(a, k):
    """Read a vector."""
    return load(a, k), load(a, k + 1), load(a, k + 2)


@traced
def load6(a, k):
    """Read a symmetric matrix."""
    return (*load3(a, k), *load3(a, k + 3))


@traced
def load9(a, k):
    """Read a matrix."""
    return (*load6(a, k), *load3(a, k + 6))


@traced
def number3(a, k):
    """Read a vector that is the same in all lanes."""
    return a[k, 0], a[k, 1], a[k, 2]


@traced
def number9(a, k):
    """Read a matrix that is the same in all lanes."""
    return tuple(a[k, column] for column in range(9))


@traced
def add(a, b):
    """Add vectors or matrices."""
    return tuple(x + y for x, y in zip(a, b, strict=True))


@traced
def sub(a, b):
    """Subtract vectors or matrices."""
    return tuple(x - y for x, y in zip(a, b, strict=True))


@traced
def times(f, v):
    """Multiply a vector or matrix by a number."""
    return tuple(f * x for x in v)


@traced
def add_to(a, k, more):
    """Add a number, vector or matrix to one in an array."""
    if isinstance(more, tuple):
        store(a, k, tuple(load(a, k + q) + each for q, each in enumerate(more)))
    else:
        store(a, k, load(a, k) + more)


@traced
def dot(a, b):
    """Return the scalar product of vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@traced
def cross(a, b):
    """Return the cross product of vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@traced
def apply(m, v):
    """Multiply a matrix and a vector."""
    return tuple(dot(row, v) for row in _rows(m))


@traced
def apply_even(m, v):
    """Multiply a symmetric matrix and a vector."""
    return apply(whole(m), v)


@traced
def outer(a, b):
    """Return the matrix a bᵀ."""
    return tuple(x * y for x in a for y in b)


@traced
def whole(m):
    """Return all nine elements of a symmetric matrix."""
    return m[0], m[3], m[4], m[3], m[1], m[5], m[4], m[5], m[2]


@traced
def upper(m):
    """Return a matrix that is symmetric as such, by its upper half."""
    return m[0], m[4], m[8], m[1], m[2], m[5]


@traced
def inverse_even(m):
    """Invert a symmetric matrix."""
    a = m[1] * m[2] - m[5] * m[5]
    b = m[4] * m[5] - m[3] * m[2]
    c = m[3] * m[5] - m[4] * m[1]
    f = 1.0 / (m[0] * a + m[3] * b + m[4] * c)
    return (
        f * a, f * (m[0] * m[2] - m[4] * m[4]), f * (m[0] * m[1] - m[3] * m[3]),
        f * b, f * c, f * (m[3] * m[4] - m[0] * m[5]),
    )  # fmt: skip


@traced
def product(a, b):
    """Multiply matrices."""
    return transposed([x for column in _columns(b) for x in apply(a, column)])


@traced
def less_product(m, a, b):
    """Subtract a product of matrices that is symmetric from a symmetric matrix."""
    for column, row in zip(_columns(a), _rows(b), strict=True):
        m = sub(m, upper(outer(column, row)))
    return m


@traced
def crossed(m, r):
    """Multiply a matrix M and [r]× from the right."""
    # Each row v of M becomes v × r, which is vᵀ [r]×.
    return tuple(x for row in _rows(m) for x in cross(row, r))


@traced
def cross_matrix(r, m):
    """Multiply [r]× and a matrix."""
    return transposed([x for column in _columns(m) for x in cross(r, column)])


@traced
def transposed(m):
    """Transpose a matrix."""
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]


def _rows(m):
    return m[:3], m[3:6], m[6:]


def _columns(m):
    return m[::3], m[1::3], m[2::3]


@traced
def hamilton(p, q):
    """Return the Hamilton product p ⊗ q: the rotation q followed by p."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@traced
def rotated(q, v):
    """Turn a vector by a unit quaternion."""
    axis = q[1], q[2], q[3]
    t = times(2.0, cross(axis, v))
    return add(v, add(times(q[0], t), cross(axis, t)))


@traced
def rotation_of(q):
    """Return the rotation matrix of a quaternion of any length."""
    w, x, y, z = q
    f = 2.0 / (w * w + x * x + y * y + z * z)
    fx, fy, fz = f * x, f * y, f * z
    return (
        1.0 - fy * y - fz * z, fx * y - fz * w, fx * z + fy * w,
        fx * y + fz * w, 1.0 - fx * x - fz * z, fy * z - fx * w,
        fx * z - fy * w, fy * z + fx * w, 1.0 - fx * x - fy * y,
    )  # fmt: skip
