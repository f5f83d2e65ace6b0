"""Constraints between nodes: products of two linear maps.

A body-fixed point or vector is a fixed combination of nodes, so each constraint is of degree two:
(U x) · (W x) = c for lengths, right angles and sliders, and for points that coincide, whose gap has
no part along the world's axes. Their Jacobians and second derivatives follow by hand.
"""

from __future__ import annotations

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
    """Coefficients of the constraints."""

    first: Array
    """U, shape (row, node)."""
    second: Array
    """W, shape (row, node)."""
    goal: Array
    """c [m²], or [m] where W is an axis of the world; shape (row,)."""


def rows_of(mechanism: Mechanism, points: Points) -> PointRows:
    """Write down the rows of rigid bodies and joints, of which none follows from the others."""
    products: list[tuple[Array, Array, float]] = []
    for joint in mechanism.joints:
        products += _coincidence(joint, points)
    for body in points.bodies:
        products += _rigid(body, points.count)
    for joint in mechanism.joints:
        products += _aligned(joint, points)
    for link in mechanism.distances:
        span = points.span(link.bodies, link.in_body)
        products.append((span, span, link.length**2))
    rows = PointRows(
        np.array([row[0] for row in products]).reshape(-1, points.count),
        np.array([row[1] for row in products]).reshape(-1, points.count),
        np.array([row[2] for row in products]),
    )
    kept = _independent(mechanism, points, rows)
    return PointRows(rows.first[kept], rows.second[kept], rows.goal[kept])


def _rigid(body: BodyPoints, count: int) -> list[tuple[Array, Array, float]]:
    """Lengths of a body's axes, and the right angles between them."""
    axes = [body.vector(u, count) * d for u, d in zip(body.directions, body.distances, strict=True)]
    return [
        (axes[i], axes[j], float(body.distances[i] ** 2) if i == j else 0.0)
        for i in range(len(axes))
        for j in range(i, len(axes))
    ]


def _coincidence(joint: PlacedJoint, points: Points) -> list[tuple[Array, Array, float]]:
    if joint.kind == "slider":
        return []
    gap = points.span((joint.parent, joint.child), (joint.in_parent, joint.in_child))
    moving = np.abs(gap).max() > _ROUNDING  # weights are of order one
    return [(gap, points.world.vector(axis, points.count), 0.0) for axis in _AXES if moving]


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


def _independent(mechanism: Mechanism, points: Points, rows: PointRows) -> NDArray[np.bool_]:
    """Whether a row does not follow from those before it, at a drawn start."""
    start = draw_batch(mechanism.scene, [2], noise=False, inputs=False)
    free = points.place(start.position[0], mechanism.native_rotation(start.orientation[0]))
    x = np.concatenate([free, points.fixed])
    product = rows.first[:, :, None] * (rows.second @ x)[:, None]
    product += rows.second[:, :, None] * (rows.first @ x)[:, None]
    dense = product[:, : points.free].reshape(len(rows.goal), 3 * points.free)
    basis = np.zeros((0, dense.shape[1]))
    kept = np.zeros(len(dense), dtype=bool)
    for k, row in enumerate(dense):
        length = np.linalg.norm(row)
        left = row
        for _ in range(2):  # twice is enough (Kahan and Parlett)
            left = left - basis.T @ (basis @ left)
        kept[k] = np.linalg.norm(left) > _DEPENDENT * length
        if kept[k]:
            basis = np.concatenate([basis, left[None] / np.linalg.norm(left)])
    return kept
