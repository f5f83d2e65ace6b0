"""Unit quaternions (wxyz) and rotations, vectorised over leading axes.

A result has the memory layout of the first operand. Everything is several times faster if that
layout stores each component contiguously.
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array

IDENTITY: Array = np.array([1.0, 0.0, 0.0, 0.0])
IDENTITY.flags.writeable = False
_HALF_TURN = 1e-9
"""Angles less than this above −π [rad] count as π, of which they are rounding errors."""


def cross(a: Array, b: Array) -> Array:
    """Cross products along the last axis, bit for bit those of numpy but faster."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    product = np.empty_like(a, float, shape=np.broadcast_shapes(a.shape, b.shape))
    np.subtract(a1 * b2, a2 * b1, out=product[..., 0])
    np.subtract(a2 * b0, a0 * b2, out=product[..., 1])
    np.subtract(a0 * b1, a1 * b0, out=product[..., 2])
    return product


def norm(v: Array) -> Array:
    """Lengths along a short last axis, bit for bit those of numpy but faster."""
    square = v[..., 0] ** 2
    for k in range(1, v.shape[-1]):
        square += v[..., k] ** 2
    return np.sqrt(square)


def dot(a: Array, b: Array) -> Array:
    """Scalar products along a last axis of three, the same sums as numpy's but faster."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def multiply(p: Array, q: Array) -> Array:
    """Hamilton product p ⊗ q: the rotation q followed by p."""
    pw, px, py, pz = (p[..., k] for k in range(4))
    qw, qx, qy, qz = (q[..., k] for k in range(4))
    product = np.empty_like(p, float, shape=np.broadcast_shapes(p.shape, q.shape))
    product[..., 0] = pw * qw - px * qx - py * qy - pz * qz
    product[..., 1] = pw * qx + px * qw + py * qz - pz * qy
    product[..., 2] = pw * qy - px * qz + py * qw + pz * qx
    product[..., 3] = pw * qz + px * qy - py * qx + pz * qw
    return product


def conjugate(q: Array) -> Array:
    """Inverse rotation of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: Array, v: Array) -> Array:
    """Turn the vectors v by the unit quaternions q."""
    # Component by component: broadcasting along an axis of three is several times slower.
    w, x, y, z = (q[..., k] for k in range(4))
    a, b, c = (v[..., k] for k in range(3))
    ta = 2.0 * (y * c - z * b)
    tb = 2.0 * (z * a - x * c)
    tc = 2.0 * (x * b - y * a)
    turned = np.empty_like(q, float, shape=(*ta.shape, 3))
    turned[..., 0] = a + w * ta + (y * tc - z * tb)
    turned[..., 1] = b + w * tb + (z * ta - x * tc)
    turned[..., 2] = c + w * tc + (x * tb - y * ta)
    return turned


def matrix(q: Array) -> Array:
    """Rotation matrices of unit quaternions, shape (..., 3, 3)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(r: Array) -> Array:
    """Unit quaternions of rotation matrices, computed from the largest of the four components."""
    m00, m11, m22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    # Each column is 4·(component)·q; the longest one is the well-conditioned one.
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    columns = np.stack(
        [
            np.stack([1 + m00 + m11 + m22, a, b, c], axis=-1),
            np.stack([a, 1 + m00 - m11 - m22, d, e], axis=-1),
            np.stack([b, d, 1 - m00 + m11 - m22, f], axis=-1),
            np.stack([c, e, f, 1 - m00 - m11 + m22], axis=-1),
        ],
        axis=-2,
    )
    norms = np.linalg.norm(columns, axis=-1)
    best = np.argmax(norms, axis=-1)[..., None]
    column = np.take_along_axis(columns, best[..., None], axis=-2)[..., 0, :]
    return np.asarray(column / np.take_along_axis(norms, best, axis=-1))


def from_vector(v: Array) -> Array:
    """Unit quaternions of rotation vectors (axis times angle [rad])."""
    half = 0.5 * norm(v)
    q = np.empty_like(v, float, shape=(*v.shape[:-1], 4))
    q[..., 0] = np.cos(half)
    q[..., 1:] = (0.5 * np.sinc(half / np.pi))[..., None] * v
    return q


def to_vector(q: Array) -> Array:
    """Rotation vectors of unit quaternions, of length at most π."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = norm(q[..., 1:])
    angle = 2.0 * np.arctan2(sine, q[..., 0])
    # angle/sine tends to 2 as the rotation vanishes.
    small = sine < 1e-12
    stretch = np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return np.asarray(q[..., 1:] * stretch[..., None])


def continuous(q: Array, first: Array) -> Array:
    """Choose between q and −q, the same rotation, so that frames follow each other closely.

    Learned models and finite differences would take a change of sign for a jump.

    Args:
        q: Unit quaternions, shape (trajectory, frame, …, 4); NaN where there is none.
        first: Unit quaternions to which frame 0 must be near, shape (trajectory, …, 4).
    """
    before = np.concatenate([first[:, None], q[:, :-1]], axis=1)
    turned = np.sum(before * q, axis=-1, keepdims=True) < 0
    return np.where(np.cumsum(turned, axis=1) % 2, -q, q) if turned.any() else q


def between(a: Array, b: Array) -> Array:
    """Return the smallest rotation that takes direction a to direction b (not opposite to a)."""
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    q = np.concatenate([1.0 + np.sum(a * b, axis=-1, keepdims=True), np.cross(a, b)], axis=-1)
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def angle_about(q: Array, axis: Array) -> Array:
    """Signed angle in (−π, π] of the part of the rotation q that turns about a unit axis [rad].

    Rotations by π within rounding give π, or exceed it by at most 1e-9.
    """
    along = dot(q[..., 1:], axis)
    angle = 2.0 * np.arctan2(along, q[..., 0])
    wrapped = np.asarray(np.pi - (np.pi - angle) % (2.0 * np.pi))
    np.add(wrapped, 2.0 * np.pi, out=wrapped, where=wrapped <= _HALF_TURN - np.pi)
    return wrapped


def normal_to(axes: Array) -> tuple[Array, Array]:
    """Two unit vectors that make right-handed triads (first, second, axis), shapes (…, 3)."""
    axes = axes / np.sqrt(squares(axes))
    first = cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=-1)])
    first /= np.sqrt(squares(first))
    return first, cross(axes, first)


def squares(vectors: Array) -> Array:
    """Squared lengths as numpy computes them for single vectors, shape (…, 1).

    These are dot products, which round differently from sums.
    """
    each = [vector @ vector for vector in vectors.reshape(-1, 3)]
    return np.reshape(each, (*vectors.shape[:-1], 1))
