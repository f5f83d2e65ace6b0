"""Rotations in torch: unit quaternions (wxyz), matrices and rotation vectors, over leading axes."""

from __future__ import annotations

import functools

import torch
from torch import Tensor


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Return the Hamilton product p ⊗ q: the rotation q followed by p."""
    scalar = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdim=True)
    vector = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:]
    return torch.cat([scalar, vector + torch.linalg.cross(p[..., 1:], q[..., 1:])], dim=-1)


def conjugate(q: Tensor) -> Tensor:
    """Return the inverse rotation of a unit quaternion."""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Turn the vectors v by the unit quaternions q."""
    v = v.expand_as(q[..., 1:])
    twice = 2.0 * torch.linalg.cross(q[..., 1:], v)
    return v + q[..., :1] * twice + torch.linalg.cross(q[..., 1:], twice)


def matrix(q: Tensor) -> Tensor:
    """Return the rotation matrices of unit quaternions, shape (…, 3, 3)."""
    products = q[..., :, None] * q[..., None, :]
    entries = products.flatten(-2) @ _turn(q.dtype, q.device)
    return entries.reshape(*q.shape[:-1], 3, 3)


def from_vector(vector: Tensor) -> Tensor:
    """Return the unit quaternions of rotation vectors (axis times angle [rad])."""
    half = 0.5 * vector.norm(dim=-1, keepdim=True)
    return torch.cat([half.cos(), 0.5 * vector * torch.sinc(half / torch.pi)], dim=-1)


def to_vector(q: Tensor) -> Tensor:
    """Return the rotation vectors [rad] of unit quaternions, no longer than π."""
    q = torch.where(q[..., :1] < 0.0, -q, q)
    size = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(size, q[..., :1])
    # For a small rotation the ratio is 2, to second order.
    return q[..., 1:] * torch.where(size > 0.0, angle / size.clamp(min=1e-300), 2.0)


@functools.cache
def _turn(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the linear map from products of a unit quaternion's components to its matrix."""
    products = torch.zeros(3, 3, 4, 4, dtype=dtype)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for axis, sign in ((0, 1.0), (1 + i, 1.0), (1 + j, -1.0), (1 + k, -1.0)):
            products[i, i, axis, axis] = sign
        products[i, j, 1 + i, 1 + j] = products[j, i, 1 + i, 1 + j] = 2.0
        products[j, i, 0, 1 + k], products[i, j, 0, 1 + k] = 2.0, -2.0
    return products.reshape(9, 16).T.contiguous().to(device)
