"""Constraints between nodes: linear rows, and products of two linear maps.

A body-fixed point or vector is a fixed combination of nodes, so each constraint is of degree two:
(U x) · (W x) = c for lengths, right angles and sliders, L x = 0 for points that coincide. Their
Jacobians and second derivatives follow by hand.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.learn.mechanics_points import BodyPoints, Points
from mbds_xsim.mechanism import Mechanism, PlacedJoint
from mbds_xsim.sampling import draw_batch

__all__ = ["PointRows", "rows_of"]

Array = NDArray[np.float64]

_AXES = np.eye(3)
_DEPENDENT = 1e-9
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class PointRows:
    """Coefficients of the constraints; scalar rows are the linear ones, then the products."""

    linear: Array
    """L, three scalar rows (x, y, z) each, shape (linear, node)."""
    first: Array
    """U, shape (product, node)."""
    second: Array
    """W, shape (product, node)."""
    goal: Array
    """c [m²], shape (product,)."""
    kept: NDArray[np.int64]
    """Independent ones among the 3 · linear + product scalar rows."""


def rows_of(mechanism: Mechanism, points: Points) -> PointRows:
    """Write down the rows of rigid bodies and joints, and find the independent ones."""
    products: list[tuple[Array, Array, float]] = []
    linear: list[Array] = []
    for body in points.bodies:
        products += _rigid(body, points.count)
    for joint in mechanism.joints:
        linear += _coincidence(joint, points)
        products += _aligned(joint, points)
    for link in mechanism.distances:
        span = points.span(link.bodies, link.in_body)
        products.append((span, span, link.length**2))
    rows = PointRows(
        np.array(linear).reshape(-1, points.count),
        np.array([row[0] for row in products]).reshape(-1, points.count),
        np.array([row[1] for row in products]).reshape(-1, points.count),
        np.array([row[2] for row in products]),
        np.arange(3 * len(linear) + len(products)),
    )
    return dataclasses.replace(rows, kept=_independent(mechanism, points, rows))


def _rigid(body: BodyPoints, count: int) -> list[tuple[Array, Array, float]]:
    """Lengths of a body's axes, and the right angles between them."""
    axes = [body.vector(u, count) * d for u, d in zip(body.directions, body.distances, strict=True)]
    return [
        (axes[i], axes[j], float(body.distances[i] ** 2) if i == j else 0.0)
        for i in range(len(axes))
        for j in range(i, len(axes))
    ]


def _coincidence(joint: PlacedJoint, points: Points) -> list[Array]:
    if joint.kind == "slider":
        return []
    gap = points.span((joint.parent, joint.child), (joint.in_parent, joint.in_child))
    moving = np.abs(gap).max() > _ROUNDING  # weights are of order one
    return [gap] if moving else []


def _aligned(joint: PlacedJoint, points: Points) -> list[tuple[Array, Array, float]]:
    """Right angles between vectors of the two bodies, and a slider's line."""
    parent, child = points.of_body(joint.parent), points.of_body(joint.child)
    pairs: list[tuple[Array, Array]] = []
    if joint.kind == "hinge":
        pairs = [(n, joint.axis) for n in rotation.normal_to(joint.axis)]
    if joint.kind in ("slider", "fixed"):
        pairs = [(_AXES[(k + 1) % 3], _AXES[k]) for k in range(3)]
    rows = [(parent.vector(n, points.count), child.vector(a, points.count), 0.0) for n, a in pairs]
    if joint.kind == "slider":
        gap = points.span((joint.parent, joint.child), (joint.in_parent, joint.in_child))
        rows += [(parent.vector(n, points.count), gap, 0.0) for n in rotation.normal_to(joint.axis)]
    return rows


def _independent(mechanism: Mechanism, points: Points, rows: PointRows) -> NDArray[np.int64]:
    """Scalar rows that do not follow from those before them, at a drawn start."""
    start = draw_batch(mechanism.scene, [2], noise=False, inputs=False)
    free = points.place(start.position[0], mechanism.native_rotation(start.orientation[0]))
    x = np.concatenate([free, points.fixed])
    scale = np.zeros((points.count, 1))
    scale[: points.free, 0] = 1.0
    product = rows.first[:, :, None] * (rows.second @ x)[:, None]
    product += rows.second[:, :, None] * (rows.first @ x)[:, None]
    straight = np.einsum("rn,ij->rinj", rows.linear, _AXES).reshape(-1, points.count, 3)
    dense = (np.concatenate([straight, product]) * scale).reshape(-1, 3 * points.count)
    basis = np.zeros((0, dense.shape[1]))
    kept = []
    for k, row in enumerate(dense):
        length = np.linalg.norm(row)
        left = row
        for _ in range(2):  # twice is enough (Kahan and Parlett)
            left = left - basis.T @ (basis @ left)
        if np.linalg.norm(left) > _DEPENDENT * length:
            basis = np.concatenate([basis, left[None] / np.linalg.norm(left)])
            kept.append(k)
    return np.array(kept, dtype=np.int64)
