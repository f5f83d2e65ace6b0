"""Vectors and matrices in space for compiled kernels; each element is eight trajectories' numbers.

Vectors are tuples of three, symmetric matrices of six (xx, yy, zz, xy, xz, yz), other matrices of
nine, row by row, quaternions of four (wxyz).
"""

from __future__ import annotations

from mbds_xsim.reference.traced import load, store, traced


@traced
def load3(a, k):
    """Read a vector."""
    return load(a, k), load(a, k + 1), load(a, k + 2)


@traced
def store3(a, k, v):
    """Write a vector."""
    store(a, k, v[0])
    store(a, k + 1, v[1])
    store(a, k + 2, v[2])


@traced
def load6(a, k):
    """Read a symmetric matrix."""
    x, y = load3(a, k), load3(a, k + 3)
    return x[0], x[1], x[2], y[0], y[1], y[2]


@traced
def store6(a, k, m):
    """Write a symmetric matrix."""
    store3(a, k, (m[0], m[1], m[2]))
    store3(a, k + 3, (m[3], m[4], m[5]))


@traced
def load9(a, k):
    """Read a matrix."""
    return (
        load(a, k), load(a, k + 1), load(a, k + 2), load(a, k + 3), load(a, k + 4), load(a, k + 5),
        load(a, k + 6), load(a, k + 7), load(a, k + 8),
    )  # fmt: skip


@traced
def store9(a, k, m):
    """Write a matrix."""
    store3(a, k, (m[0], m[1], m[2]))
    store3(a, k + 3, (m[3], m[4], m[5]))
    store3(a, k + 6, (m[6], m[7], m[8]))


@traced
def number3(a, k):
    """Read three numbers that are the same in all lanes."""
    return a[k, 0], a[k, 1], a[k, 2]


@traced
def add(a, b):
    """Add vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@traced
def add_to3(a, k, v):
    """Add a vector to one in an array."""
    store3(a, k, add(load3(a, k), v))


@traced
def add_to(a, k, more):
    """Add a number to one in an array."""
    store(a, k, load(a, k) + more)


@traced
def sub(a, b):
    """Subtract vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@traced
def times(f, v):
    """Multiply a vector by a number."""
    return f * v[0], f * v[1], f * v[2]


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
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
        m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
    )


@traced
def apply_turned(m, v):
    """Multiply a transposed matrix and a vector."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )


@traced
def apply_even(m, v):
    """Multiply a symmetric matrix and a vector."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[3] * v[0] + m[1] * v[1] + m[5] * v[2],
        m[4] * v[0] + m[5] * v[1] + m[2] * v[2],
    )


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
    x, y, z = (b[0], b[3], b[6]), (b[1], b[4], b[7]), (b[2], b[5], b[8])
    return _columns(apply(a, x), apply(a, y), apply(a, z))


@traced
def even_product(a, b):
    """Multiply a symmetric matrix and another one."""
    x, y, z = (b[0], b[3], b[6]), (b[1], b[4], b[7]), (b[2], b[5], b[8])
    return _columns(apply_even(a, x), apply_even(a, y), apply_even(a, z))


@traced
def crossed_even(m, r):
    """Multiply a symmetric matrix M and [r]× from the right."""
    x, y, z = (m[0], m[3], m[4]), (m[3], m[1], m[5]), (m[4], m[5], m[2])
    # Each row v of M becomes v × r, which is vᵀ [r]×.
    a, b, c = cross(x, r), cross(y, r), cross(z, r)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@traced
def cross_matrix(r, m):
    """Multiply [r]× and a matrix."""
    x, y, z = (m[0], m[3], m[6]), (m[1], m[4], m[7]), (m[2], m[5], m[8])
    return _columns(cross(r, x), cross(r, y), cross(r, z))


@traced
def transposed(m):
    """Transpose a matrix."""
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]


@traced
def _columns(x, y, z):
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


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
