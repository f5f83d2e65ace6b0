"""Projection of predicted particles onto rigid bodies (Kabsch), for rollouts."""

from __future__ import annotations

import torch
from torch import Tensor

from mbds_xsim.learn.sgnn_topology import pool

__all__ = ["nearest_rigid"]


def nearest_rigid(shape: Tensor, predicted: Tensor, object_of: Tensor) -> Tensor:
    """Move each object's shape, without deforming it, next to where its particles were predicted.

    The motion has the least sum of squared distances and is proper: never a mirror image. An
    object of one particle, or of particles on a line, keeps its shape trivially. Where a row
    has a number that is not finite, its result is not a number.

    W. Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32
    (1976) 922.

    Args:
        shape: particles with the right distances, any pose, shape (…, particle, 3).
        predicted: shape (…, particle, 3).
        object_of: the object of each particle, from 0 without gaps, shape (particle,).

    Returns:
        Shape (…, particle, 3).
    """
    kind = torch.arange(int(object_of.max()) + 1, device=object_of.device)
    if len(kind) == len(object_of):
        return predicted  # a point has no shape to keep, and decompositions are dear
    belongs = (object_of == kind[:, None]).to(predicted)
    members = belongs / belongs.sum(dim=1, keepdim=True)
    arms = shape - (members @ shape)[..., object_of, :]
    centre = members @ predicted
    reached = predicted - centre[..., object_of, :]
    products = reached.unsqueeze(-1) * arms.unsqueeze(-2)
    covariance = pool(belongs, products)
    turned = (_rotation(covariance)[..., object_of, :, :] @ arms.unsqueeze(-1)).squeeze(-1)
    return centre[..., object_of, :] + turned


def _rotation(covariance: Tensor) -> Tensor:
    """Rotation nearest to a matrix (…, 3, 3); any where it is not finite, as an SVD would fail."""
    finite = covariance.isfinite().all(dim=-1).all(dim=-1)[..., None, None]
    left, _, right = torch.linalg.svd(torch.where(finite, covariance, 0.0))
    signs = torch.ones_like(left[..., 0])
    signs[..., -1] = torch.det(left @ right).sign()
    return left @ (signs.unsqueeze(-1) * right)
