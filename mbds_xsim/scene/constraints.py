"""Holonomic constraints of a mechanism in maximal coordinates: residual, Jacobian, bias.

One *row* is one scalar equation g = 0 between two bodies. With the twist (v, ω) of each body in
W, its rate is ġ = J_parent · twist_parent + J_child · twist_child, and its second derivative adds
the *bias* J̇ · twist. Rows come in four elementary forms (Haug, Computer-Aided Kinematics and
Dynamics of Mechanical Systems, 1989, section 9.4), from which every joint is put together:

- point: e · (p_child − p_parent), e a world axis: three make a ball joint;
- along: n · (p_child − p_parent), n fixed in the parent: two make a slider's line;
- normal: a · n, a fixed in the child and n in the parent: two make a hinge, three a lock;
- distance: |p_child − p_parent| − L.

All functions are vectorised over leading axes. The world is a body at rest with index −1.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mbds_xsim.base import rotation
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint
from mbds_xsim.scene.row_space import independent_rows

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_AXES = np.eye(3)


@dataclass(frozen=True, eq=False)
class Rows:
    """Every row of a mechanism at given states."""

    parent: Indices
    """Body of the row's first end (−1 the world), shape (row,)."""
    child: Indices
    owner: Indices
    """Joint (scene order) that the row belongs to, then the distance links behind; (row,)."""
    residual: Array
    """g [m, or rad for directions], shape (…, row)."""
    jacobian_parent: Array
    """Coefficients of the parent's (v, ω), shape (…, row, 6)."""
    jacobian_child: Array
    bias: Array
    """J̇ · twist [m/s² or rad/s²], shape (…, row)."""


@dataclass(frozen=True, eq=False)
class _Layout:
    """Constant parts of the rows, grouped by form. Directions and points in native frames."""

    point_joints: tuple[Indices, Indices, Array, Array, Indices]
    along: tuple[Indices, Indices, Array, Array, Array, Indices]
    normal: tuple[Indices, Indices, Array, Array, Indices]
    distance: tuple[Indices, Indices, Array, Array, Array, Indices]
    parent: Indices
    child: Indices
    owner: Indices


def constraint_rows(
    mechanism: Mechanism,
    position: Array,
    native: Array,
    velocity: Array,
    angular_velocity: Array,
) -> Rows:
    """Evaluate all rows, point rows first, then along, normal, distance.

    Args:
        mechanism: Whose constraints.
        position: Centres of mass in W [m], shape (…, body, 3).
        native: Rotations of the native frames, shape (…, body, 4).
        velocity: Of the centres of mass in W [m/s], shape (…, body, 3).
        angular_velocity: In W [rad/s], shape (…, body, 3).
    """
    layout = _layout(mechanism)
    lead = position.shape[:-2]
    world = np.zeros((*lead, 1, 3))
    x = np.concatenate([position, world], axis=-2)
    v = np.concatenate([velocity, world], axis=-2)
    w = np.concatenate([angular_velocity, world], axis=-2)
    q = np.concatenate([native, np.broadcast_to(rotation.IDENTITY, (*lead, 1, 4))], axis=-2)
    turn = rotation.matrix(q)
    parts = [
        _point_rows(layout, x, turn, w),
        _along_rows(layout, x, turn, v, w),
        _normal_rows(layout, turn, w),
        _distance_rows(layout, x, turn, v, w),
    ]
    residual, jacobian_parent, jacobian_child, bias = (
        np.concatenate([part[k] for part in parts], axis=axis)
        for k, axis in enumerate((-1, -2, -2, -1))
    )
    return Rows(
        layout.parent, layout.child, layout.owner, residual, jacobian_parent, jacobian_child, bias
    )


def dense_jacobian(rows: Rows, body_count: int) -> Array:
    """Scatter the blocks into one matrix, shape (…, row, 6 · body), without the world."""
    count = len(rows.parent)
    lead = rows.jacobian_parent.shape[:-2]
    dense = np.zeros((*lead, count, body_count + 1, 6))
    each = np.arange(count)
    dense[..., each, rows.parent, :] = rows.jacobian_parent
    dense[..., each, rows.child, :] += rows.jacobian_child
    return dense[..., :body_count, :].reshape(*lead, count, 6 * body_count)


def sparse_jacobian(rows: Rows, body_count: int) -> csr_array:
    """Do the same for rows of one state, without the zeros."""
    count = len(rows.parent)
    ends = np.concatenate([rows.parent, rows.child])
    blocks = np.concatenate([rows.jacobian_parent, rows.jacobian_child])
    held = ends >= 0
    row = np.repeat(np.tile(np.arange(count), 2)[held], 6)
    column = (6 * ends[held, None] + np.arange(6)).reshape(-1)
    matrix = csr_array((blocks[held].reshape(-1), (row, column)), shape=(count, 6 * body_count))
    matrix.eliminate_zeros()
    return matrix


def degrees_of_freedom(mechanism: Mechanism) -> int:
    """Degrees of freedom at the reference pose: coordinates less independent rows.

    A mechanism that passes a singular configuration there counts more than elsewhere.
    """
    still = np.zeros((mechanism.body_count, 3))
    native = np.broadcast_to(rotation.IDENTITY, (mechanism.body_count, 4))
    rows = constraint_rows(mechanism, mechanism.com, native, still, still)
    if not (mechanism.loops or mechanism.distances):
        return 6 * mechanism.body_count - len(rows.parent)
    jacobian = sparse_jacobian(rows, mechanism.body_count)
    return 6 * mechanism.body_count - len(independent_rows(jacobian))


@functools.lru_cache(maxsize=64)
def _layout(mechanism: Mechanism) -> _Layout:
    pointed = [j for j in mechanism.joints if j.kind != "slider"]
    along: list[tuple[PlacedJoint, Array]] = []
    normal: list[tuple[PlacedJoint, Array, Array]] = []
    for joint in mechanism.joints:
        if joint.kind == "slider":
            along += [(joint, n) for n in rotation.normal_to(joint.axis)]
        if joint.kind == "hinge":
            normal += [(joint, joint.axis, n) for n in rotation.normal_to(joint.axis)]
        if joint.kind in ("slider", "fixed"):
            normal += [(joint, _AXES[k], _AXES[(k + 1) % 3]) for k in range(3)]
    links = mechanism.distances
    first_link = len(mechanism.joints)

    def ends(items: list[PlacedJoint]) -> tuple[Indices, Indices]:
        return (
            np.array([j.parent for j in items], dtype=np.int64),
            np.array([j.child for j in items], dtype=np.int64),
        )

    def vectors(items: list[Array]) -> Array:
        return np.array(items, dtype=float).reshape(-1, 3)

    def owners(items: list[PlacedJoint]) -> Indices:
        return np.array([j.index for j in items], dtype=np.int64)

    pp, pc = ends(pointed)
    ap, ac = ends([j for j, _ in along])
    np_, nc = ends([j for j, _, _ in normal])
    dp = np.array([link.bodies[0] for link in links], dtype=np.int64)
    dc = np.array([link.bodies[1] for link in links], dtype=np.int64)
    down = first_link + np.arange(len(links))
    point_owner = owners(pointed)
    along_owner = owners([j for j, _ in along])
    normal_owner = owners([j for j, _, _ in normal])
    return _Layout(
        point_joints=(
            pp,
            pc,
            vectors([j.in_parent for j in pointed]),
            vectors([j.in_child for j in pointed]),
            point_owner,
        ),
        along=(
            ap,
            ac,
            vectors([j.in_parent for j, _ in along]),
            vectors([j.in_child for j, _ in along]),
            vectors([n for _, n in along]),
            along_owner,
        ),
        normal=(
            np_,
            nc,
            vectors([n for _, _, n in normal]),
            vectors([a for _, a, _ in normal]),
            normal_owner,
        ),
        distance=(
            dp,
            dc,
            vectors([link.in_body[0] for link in links]),
            vectors([link.in_body[1] for link in links]),
            np.array([link.length for link in links]),
            down,
        ),
        parent=np.concatenate([np.repeat(pp, 3), ap, np_, dp]),
        child=np.concatenate([np.repeat(pc, 3), ac, nc, dc]),
        owner=np.concatenate([np.repeat(point_owner, 3), along_owner, normal_owner, down]),
    )


_Part = tuple[Array, Array, Array, Array]


def _turned(turn: Array, body: Indices, vector: Array) -> Array:
    return np.einsum("...kij,kj->...ki", turn[..., body, :, :], vector)


def _point_rows(layout: _Layout, x: Array, turn: Array, w: Array) -> _Part:
    parent, child, in_parent, in_child, _ = layout.point_joints
    rp, rc = _turned(turn, parent, in_parent), _turned(turn, child, in_child)
    wp, wc = w[..., parent, :], w[..., child, :]
    gap = x[..., child, :] + rc - x[..., parent, :] - rp
    bias = np.cross(wc, np.cross(wc, rc)) - np.cross(wp, np.cross(wp, rp))
    lead = gap.shape[:-2]
    rows = 3 * len(parent)
    return (
        gap.reshape(*lead, rows),
        _point_block(rp, -1.0).reshape(*lead, rows, 6),
        _point_block(rc, 1.0).reshape(*lead, rows, 6),
        bias.reshape(*lead, rows),
    )


def _point_block(arm: Array, sign: float) -> Array:
    """Rows e_i · (v + ω × arm): shape (…, joint, 3, 6)."""
    block = np.zeros((*arm.shape[:-1], 3, 6))
    block[..., [0, 1, 2], [0, 1, 2]] = sign
    # e_i · (ω × r) = ω · (r × e_i)
    block[..., 0, 4], block[..., 0, 5] = sign * arm[..., 2], -sign * arm[..., 1]
    block[..., 1, 3], block[..., 1, 5] = -sign * arm[..., 2], sign * arm[..., 0]
    block[..., 2, 3], block[..., 2, 4] = sign * arm[..., 1], -sign * arm[..., 0]
    return block


def _along_rows(layout: _Layout, x: Array, turn: Array, v: Array, w: Array) -> _Part:
    parent, child, in_parent, in_child, direction, _ = layout.along
    rp, rc = _turned(turn, parent, in_parent), _turned(turn, child, in_child)
    n = _turned(turn, parent, direction)
    wp, wc = w[..., parent, :], w[..., child, :]
    d = x[..., child, :] + rc - x[..., parent, :] - rp
    d_rate = v[..., child, :] + np.cross(wc, rc) - v[..., parent, :] - np.cross(wp, rp)
    d_bias = np.cross(wc, np.cross(wc, rc)) - np.cross(wp, np.cross(wp, rp))
    n_rate = np.cross(wp, n)
    bias = _dot(n, d_bias) + 2.0 * _dot(n_rate, d_rate) + _dot(np.cross(wp, n_rate), d)
    return (
        _dot(n, d),
        np.concatenate([-n, -np.cross(rp + d, n)], axis=-1),
        np.concatenate([n, np.cross(rc, n)], axis=-1),
        bias,
    )


def _normal_rows(layout: _Layout, turn: Array, w: Array) -> _Part:
    parent, child, in_parent, in_child, _ = layout.normal
    n, a = _turned(turn, parent, in_parent), _turned(turn, child, in_child)
    wp, wc = w[..., parent, :], w[..., child, :]
    n_rate, a_rate = np.cross(wp, n), np.cross(wc, a)
    bias = (
        _dot(np.cross(wc, a_rate), n) + 2.0 * _dot(a_rate, n_rate) + _dot(a, np.cross(wp, n_rate))
    )
    lever = np.cross(a, n)
    zero = np.zeros_like(lever)
    return (
        _dot(a, n),
        np.concatenate([zero, -lever], axis=-1),
        np.concatenate([zero, lever], axis=-1),
        bias,
    )


def _distance_rows(layout: _Layout, x: Array, turn: Array, v: Array, w: Array) -> _Part:
    parent, child, in_parent, in_child, length, _ = layout.distance
    rp, rc = _turned(turn, parent, in_parent), _turned(turn, child, in_child)
    wp, wc = w[..., parent, :], w[..., child, :]
    d = x[..., child, :] + rc - x[..., parent, :] - rp
    d_rate = v[..., child, :] + np.cross(wc, rc) - v[..., parent, :] - np.cross(wp, rp)
    d_bias = np.cross(wc, np.cross(wc, rc)) - np.cross(wp, np.cross(wp, rp))
    distance = np.linalg.norm(d, axis=-1)
    u = d / distance[..., None]
    along = _dot(u, d_rate)
    bias = _dot(u, d_bias) + (_dot(d_rate, d_rate) - along**2) / distance
    return (
        distance - length,
        np.concatenate([-u, -np.cross(rp, u)], axis=-1),
        np.concatenate([u, np.cross(rc, u)], axis=-1),
        bias,
    )


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))
