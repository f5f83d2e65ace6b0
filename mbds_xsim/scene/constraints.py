"""Holonomic constraints of a mechanism in maximal coordinates: residual, Jacobian, bias.

One *row* is one scalar equation g = 0 between two bodies. With the twist (v, ω) of each body in
W, its rate is ġ = J_parent · twist_parent + J_child · twist_child, and its second derivative adds
the *bias* J̇ · twist. Rows come in four elementary forms (Haug, Computer-Aided Kinematics and
Dynamics of Mechanical Systems, 1989, section 9.4), from which every joint is built:

- point: e · (p_child − p_parent), e a world axis: three make a ball joint;
- along: n · (p_child − p_parent), n fixed in the parent: two make a slider's line;
- normal: a · n, a fixed in the child and n in the parent: two make a hinge, three a lock;
- distance: |p_child − p_parent| − L.

*Vectors* are fixed in a body and turn with it (arms of joints, axes, normals). They are kept in one
list, so that all are rotated at once. *Spans* are pairs of points, one per joint, link or spring;
their first and second ends come first in that list.

All functions are vectorised over leading axes. The world is a body at rest with index −1.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Indices
from mbds_xsim.scene.joint_space import BodyStates, coupling_rows
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_FEW = 400  # rows that are counted densely, which takes less time than importing scipy
_INDEPENDENT = 1e-9
_AXES = np.eye(3)
# Rows r × e_i of an arm r, as a linear map of r.
_ARM = np.array(
    [
        [0, 0, 0, 0, 0, 1, 0, -1, 0],
        [0, 0, -1, 0, 0, 0, 1, 0, 0],
        [0, 1, 0, -1, 0, 0, 0, 0, 0],
    ],
    dtype=float,
)


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """All constraint rows of a mechanism at given states."""

    parent: Indices
    """Body of the row's first end (−1 the world), shape (row,)."""
    child: Indices
    owner: Indices
    """Joint of each row (scene order), or number of joints + index of its distance link; (row,)."""
    residual: Array
    """Residual g [m, or rad for directions], shape (…, row)."""
    jacobian_parent: Array
    """Coefficients of the parent's (v, ω), shape (…, row, 6)."""
    jacobian_child: Array
    bias: Array
    """Bias J̇ · twist [m/s² or rad/s²], shape (…, row)."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Constant parts of the rows: the vectors and spans from which they are made."""

    vector_body: Indices
    vector: Array
    """Vectors in the frames of their bodies, shape (vector, 3)."""
    span_body: Indices
    """Bodies of the first and second ends, shape (2, span)."""
    points: slice
    """Spans of the ball, hinge and fixed joints."""
    along: slice
    """Spans of the rows that hold a slider on its line."""
    distances: slice
    springs: slice
    along_normal: slice
    """Vectors that are normal to a slider's line."""
    normal: slice
    """Vectors n in the parent that stay normal to the vectors a in the child (`lever`)."""
    lever: slice
    hinge: slice
    """Vectors along the hinges' axes, fixed in the parent."""
    length: Array
    """Lengths of the distance links [m]."""
    row_body: Indices
    """Bodies of the two ends of every row, shape (2, row)."""
    owner: Indices
    """Owner of each row, as in `ConstraintRows`."""

    @property
    def row_count(self) -> int:
        """Number of scalar constraints."""
        return len(self.owner)


@dataclass(frozen=True, eq=False)
class Moving:
    """Rotation matrices of bodies, and vectors and spans with two time derivatives.

    The second derivatives leave out the accelerations of the bodies.
    """

    turn: Array
    vector: tuple[Array, Array, Array]
    span: tuple[Array, Array, Array]


def constraint_rows(mechanism: Mechanism, bodies: BodyStates) -> ConstraintRows:
    """Evaluate all rows, point rows first, then along, normal, distance."""
    layout, world = layout_of(mechanism), bodies.with_world()
    turn, spin = rotation.matrix(world.native), world.angular_velocity
    motion = motion_of(layout, turn, world.position, world.velocity, spin)
    residual, bias, halves = evaluate(layout, motion)
    return ConstraintRows(
        parent=layout.row_body[0],
        child=layout.row_body[1],
        owner=layout.owner,
        residual=residual,
        jacobian_parent=halves[..., 0, :-1, :],
        jacobian_child=halves[..., 1, :-1, :],
        bias=bias,
    )


def dense_jacobian(rows: ConstraintRows, body_count: int) -> Array:
    """Scatter the blocks into one matrix, shape (…, row, 6 · body), without the world."""
    count = len(rows.parent)
    lead = rows.jacobian_parent.shape[:-2]
    dense = np.zeros((*lead, count, body_count + 1, 6))
    row = np.arange(count)
    dense[..., row, rows.parent, :] = rows.jacobian_parent
    dense[..., row, rows.child, :] += rows.jacobian_child
    return dense[..., :body_count, :].reshape(*lead, count, 6 * body_count)


def sparse_jacobian(rows: ConstraintRows, body_count: int) -> csr_array:
    """Scatter the blocks of one state into a sparse matrix, shape (row, 6 · body)."""
    from scipy.sparse import csr_array  # takes long to import

    count = len(rows.parent)
    ends = np.concatenate([rows.parent, rows.child])
    blocks = np.concatenate([rows.jacobian_parent, rows.jacobian_child])
    on_body = ends >= 0
    row = np.repeat(np.tile(np.arange(count), 2)[on_body], 6)
    column = (6 * ends[on_body, None] + np.arange(6)).reshape(-1)
    matrix = csr_array((blocks[on_body].reshape(-1), (row, column)), shape=(count, 6 * body_count))
    matrix.eliminate_zeros()
    return matrix


def degrees_of_freedom(mechanism: Mechanism) -> int:
    """Count the degrees of freedom at the reference pose: coordinates minus independent rows.

    At a singular reference pose, the count is higher than elsewhere.
    """
    reference = BodyStates.at_reference(mechanism)
    rows = constraint_rows(mechanism, reference)
    if not (mechanism.loops or mechanism.distances):
        return 6 * mechanism.body_count - len(rows.parent) - len(mechanism.couplings)
    if len(rows.parent) <= _FEW and not mechanism.couplings:
        return 6 * mechanism.body_count - _rank(dense_jacobian(rows, mechanism.body_count))
    from scipy.sparse import vstack  # takes long to import

    from mbds_xsim.scene.row_space import independent_rows

    couplings = coupling_rows(mechanism, reference)
    jacobian = vstack([sparse_jacobian(rows, mechanism.body_count), *couplings], format="csr")
    return 6 * mechanism.body_count - len(independent_rows(jacobian))


def _rank(matrix: Array) -> int:
    """Count independent rows, with columns and then rows scaled to norm 1 as in `row_space`."""
    for axis in (0, 1):
        size = np.linalg.norm(matrix, axis=axis, keepdims=True)
        matrix = matrix / np.where(size > 0.0, size, 1.0)
    return int(np.linalg.matrix_rank(matrix, tol=_INDEPENDENT))


@functools.lru_cache(maxsize=64)
def layout_of(mechanism: Mechanism) -> Layout:
    """Lay out the rows of a mechanism, with vectors in native frames (cached)."""
    joints = mechanism.joints
    points = [joint for joint in joints if joint.kind != "slider"]
    along = [(j, n) for j in joints if j.kind == "slider" for n in rotation.normal_to(j.axis)]
    normal = [(joint, a, n) for joint in joints for a, n in _normal_pairs(joint)]
    pairs = (mechanism.distances, mechanism.springs)
    groups = [
        [(joint.parent, joint.child, joint.in_parent, joint.in_child) for joint in group]
        for group in (points, [joint for joint, _ in along])
    ] + [[(*pair.bodies, *pair.in_body) for pair in group] for group in pairs]
    spans = [span for group in groups for span in group]
    vector_groups = [
        [(span[0], span[2]) for span in spans],
        [(span[1], span[3]) for span in spans],
        [(joint.parent, n) for joint, n in along],
        [(joint.parent, n) for joint, _, n in normal],
        [(joint.child, a) for joint, a, _ in normal],
        [(hinge.parent, hinge.axis) for hinge in mechanism.hinges],
    ]
    vectors = [pair for group in vector_groups for pair in group]
    of_points, of_along, of_distances, of_springs = _slices(groups)
    along_normal, of_normal, lever, hinge = _slices(vector_groups)[2:]
    ends = _indices([span[:2] for span in spans]).reshape(-1, 2).T
    normal_ends = _indices([(j.parent, j.child) for j, _, _ in normal]).reshape(-1, 2).T
    owners = [joint.index for joint in points for _ in range(3)]
    owners += [joint.index for joint, _ in along] + [joint.index for joint, _, _ in normal]
    owners += [len(joints) + k for k in range(len(mechanism.distances))]
    parts = (np.repeat(ends[:, of_points], 3, axis=1), ends[:, of_along], normal_ends)
    return Layout(
        _indices([body for body, _ in vectors]),
        np.array([vector for _, vector in vectors], dtype=float).reshape(-1, 3),
        ends,
        of_points,
        of_along,
        of_distances,
        of_springs,
        along_normal,
        of_normal,
        lever,
        hinge,
        length=np.array([link.length for link in mechanism.distances]),
        row_body=np.concatenate([*parts, ends[:, of_distances]], axis=1),
        owner=_indices(owners),
    )


def _normal_pairs(joint: PlacedJoint) -> list[tuple[Array, Array]]:
    """Return directions (a in the child, n in the parent) that stay at right angles."""
    if joint.kind == "hinge":
        return [(joint.axis, n) for n in rotation.normal_to(joint.axis)]
    if joint.kind == "ball":
        return []
    return [(_AXES[k], _AXES[(k + 1) % 3]) for k in range(3)]


def _slices(groups: Sequence[Sequence[object]]) -> list[slice]:
    """Return the slices that groups occupy when concatenated into one list."""
    ends = np.cumsum([0, *map(len, groups)]).tolist()
    return [slice(*pair) for pair in itertools.pairwise(ends)]


def _indices(values: Sequence[object]) -> Indices:
    return np.array(values, dtype=np.intp)


def motion_of(
    layout: Layout, turn: Array, x: Array, v: Array, w: Array, *, bodies_first: bool = False
) -> Moving:
    """Move vectors and spans with their bodies; the world is the last body.

    Args:
        layout: Layout of the vectors and spans.
        turn: Rotation matrices of the frames of the vectors, shape (…, body + world, 3, 3).
        x: Centres of mass in W [m], shape (…, body + world, 3).
        v: Velocities of the centres of mass [m/s].
        w: Angular velocities in W [rad/s].
        bodies_first: Whether spans add arms to the distance of the bodies, which rounds less far
            from the origin, instead of subtracting points; the bits of drawn starts depend on it.
    """
    body, (first, second) = layout.vector_body, layout.span_body
    u = np.einsum("...kij,kj->...ki", turn[..., body, :, :], layout.vector)
    spin = w[..., body, :]
    rate = rotation.cross(spin, u)
    bend = rotation.cross(spin, rate)
    count = len(first)
    a, b = slice(count), slice(count, 2 * count)

    def between(values: Array | None, arms: Array) -> Array:
        begin, end = arms[..., a, :], arms[..., b, :]
        if values is None:
            return end - begin
        if bodies_first:
            return values[..., second, :] - values[..., first, :] + end - begin
        return values[..., second, :] + end - values[..., first, :] - begin

    return Moving(turn, (u, rate, bend), (between(x, u), between(v, rate), between(None, bend)))


def evaluate(layout: Layout, motion: Moving) -> tuple[Array, Array, Array]:
    """Evaluate all rows of a layout.

    Returns:
        Residuals and biases, shape (…, row), and the Jacobian's blocks of the parent and of the
        child, shape (…, 2, row + 1, 6), whose last row is empty.
    """
    arm, (count, points) = motion.vector[0], (layout.span_body.shape[1], layout.points.stop)
    lead = arm.shape[:-2]
    halves = np.zeros((*lead, 2, layout.row_count + 1, 6))
    for end, sign, first in ((0, -1.0, 0), (1, 1.0, count)):
        # Splitting an axis makes a view, so writing to it fills the halves.
        block = halves[..., end, : 3 * points, :].reshape(*lead, points, 3, 6)
        block[..., :3] = sign * _AXES
        angular = arm[..., first : first + points, :] @ (sign * _ARM)
        block[..., 3:] = angular.reshape(*lead, points, 3, 3)
    residual = [motion.span[0][..., layout.points, :].reshape(*lead, -1)]
    bias = [motion.span[2][..., layout.points, :].reshape(*lead, -1)]
    start = 3 * points
    for part in (_along_rows, _normal_rows, _distance_rows):
        error, curvature = part(layout, motion, halves[..., start:, :])
        residual.append(error)
        bias.append(curvature)
        start += error.shape[-1]
    return np.concatenate(residual, axis=-1), np.concatenate(bias, axis=-1), halves


def _along_rows(layout: Layout, motion: Moving, halves: Array) -> tuple[Array, Array]:
    d, d_rate, d_bend = (part[..., layout.along, :] for part in motion.span)
    n, n_rate, n_bend = (part[..., layout.along_normal, :] for part in motion.vector)
    if d.shape[-2]:
        _fill_line(layout, motion, halves, layout.along, n, d)
    bias = rotation.dot(n, d_bend) + 2.0 * rotation.dot(n_rate, d_rate) + rotation.dot(n_bend, d)
    return rotation.dot(n, d), bias


def _normal_rows(layout: Layout, motion: Moving, halves: Array) -> tuple[Array, Array]:
    n, n_rate, n_bend = (part[..., layout.normal, :] for part in motion.vector)
    a, a_rate, a_bend = (part[..., layout.lever, :] for part in motion.vector)
    lever = rotation.cross(a, n)
    count = n.shape[-2]
    halves[..., 0, :count, 3:], halves[..., 1, :count, 3:] = -lever, lever
    bias = rotation.dot(a_bend, n) + 2.0 * rotation.dot(a_rate, n_rate) + rotation.dot(a, n_bend)
    return rotation.dot(a, n), bias


def _distance_rows(layout: Layout, motion: Moving, halves: Array) -> tuple[Array, Array]:
    d, d_rate, d_bend = (part[..., layout.distances, :] for part in motion.span)
    distance = rotation.norm(d)
    u = d / distance[..., None]
    if d.shape[-2]:
        _fill_line(layout, motion, halves, layout.distances, u, None)
    along = rotation.dot(u, d_rate)
    bias = rotation.dot(u, d_bend) + (rotation.dot(d_rate, d_rate) - along**2) / distance
    return distance - layout.length, bias


def _fill_line(
    layout: Layout,
    motion: Moving,
    halves: Array,
    spans: slice,
    direction: Array,
    extension: Array | None,
) -> None:
    """Fill the blocks of rows along a direction; `extension` is added to the parent's arm."""
    arm, count = motion.vector[0], layout.span_body.shape[1]
    first, second = arm[..., spans, :], arm[..., spans.start + count : spans.stop + count, :]
    if extension is not None:
        first = first + extension
    rows = slice(direction.shape[-2])
    halves[..., 0, rows, :3], halves[..., 1, rows, :3] = -direction, direction
    halves[..., 0, rows, 3:] = -rotation.cross(first, direction)
    halves[..., 1, rows, 3:] = rotation.cross(second, direction)
