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
_STARTS = 8
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
    redundant: int
    """How many of them follow from the others. Which these are depends on the pose: of a hinge in
    a plane loop one right angle is enough, but at some angle not the one that was at another."""


def rows_of(mechanism: Mechanism, points: Points) -> PointRows:
    """Write down the rows of rigid bodies and joints that hold something that moves."""
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
    first, second = (
        _cleaned(np.array([row[k] for row in products]).reshape(-1, points.count)) for k in (0, 1)
    )
    moves = (first[:, : points.free] != 0.0).any(1) | (second[:, : points.free] != 0.0).any(1)
    first, second = first[moves], second[moves]
    goal = np.array([row[2] for row in products])[moves]
    return PointRows(first, second, goal, len(goal) - _rank(mechanism, points, first, second))


def _cleaned(weights: Array) -> Array:
    """Without what rounding left: alone in a row it would be a constraint like any other."""
    largest = np.abs(weights).max(axis=1, keepdims=True, initial=0.0)
    return np.where(np.abs(weights) > _ROUNDING * largest, weights, 0.0)


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


def _rank(mechanism: Mechanism, points: Points, first: Array, second: Array) -> int:
    """Rank of the Jacobian; the largest at drawn starts, of which some may be singular."""
    start = draw_batch(mechanism.scene, range(_STARTS), noise=False, inputs=False)
    free = points.place(start.position, mechanism.native_rotation(start.orientation))
    fixed = np.broadcast_to(points.fixed, (_STARTS, *points.fixed.shape))
    x = np.concatenate([free, fixed], axis=1)
    product = first[:, :, None] * (second @ x)[:, :, None]
    product += second[:, :, None] * (first @ x)[:, :, None]
    dense = product[:, :, : points.free].reshape(_STARTS, len(first), 3 * points.free)
    dense /= np.linalg.norm(dense, axis=-1, keepdims=True)
    return int(np.linalg.matrix_rank(dense, tol=_DEPENDENT).max()) if dense.size else 0
