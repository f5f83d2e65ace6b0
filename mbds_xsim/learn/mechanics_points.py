"""Rigid bodies as points, and their constraints as products of two linear maps.

A body is its centre of mass and one *tip* on each of its principal axes (Finzi, Wang, Wilson:
Simplifying Hamiltonian and Lagrangian neural networks via explicit constraints, NeurIPS 2020). A
material point is an affine combination of these, whatever the body's motion, and the kinetic
energy is ½ m |v_com|² + ½ Σ (J_k / d_k²) |v_tip − v_com|² with J_k the second moment along the axis
and d_k the distance of the tip. So the mass matrix is constant. A body of revolution without spin
(`mbds_xsim.scene.spin`) needs only the tip on its axis. Tips lie on joints where they can, and
points that a joint keeps together are one *node*; a node at a joint to the world is fixed.

A body-fixed point or vector is a fixed combination of nodes, so each constraint is of degree two:
(U x) · (W x) = c for lengths, right angles and sliders, and for points that coincide, whose gap has
no component along the world's axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.learn.graph import instead
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.spin import idle_axes

_SAME = 1e-12  # relative, of lengths and second moments
_DIGITS = 12
_MERGING = ("ball", "hinge", "fixed")


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """Nodes of one body (or of the world, whose tips are its unit vectors)."""

    com: int
    tips: Index
    """Node of each tip, shape (tip,)."""
    directions: Array
    """Orthonormal vectors from the centre of mass to the tips, in the native frame, (tip, 3)."""
    distances: Array
    """Distances of the tips from the centre of mass [m], shape (tip,)."""

    def weights(self, point: Array, count: int) -> Array:
        """Return the nodes' weights in a point of the native frame, shape (node,)."""
        weights = self.vector(point, count)
        weights[self.com] += 1.0
        return weights

    def vector(self, vector: Array, count: int) -> Array:
        """Return the nodes' weights in a body-fixed vector, shape (node,); their sum is 0."""
        weights = np.zeros(count)
        share = self.directions @ vector / self.distances
        np.add.at(weights, self.tips, share)
        weights[self.com] -= share.sum()
        return weights


@dataclass(frozen=True, eq=False)
class NodePoints:
    """Nodes of a mechanism: the free ones, the fixed ones, then the frame of the world."""

    bodies: tuple[BodyPoints, ...]
    world: BodyPoints
    free: int
    """Number of free nodes; they come first."""
    fixed: Array
    """Positions of the other nodes in W [m], shape (fixed + 4, 3)."""
    mass: Array
    """Mass of the bodies whose centre of mass is at each node [kg], shape (node,)."""
    rods: Index
    """Nodes of each rod, its tip and centre of mass, shape (rod, 2)."""
    rod_mass: Array
    """Mass J_k / d_k² of each rod [kg], shape (rod,)."""
    rod_length: Array
    """Length d_k of each rod [m], shape (rod,)."""
    carrier: tuple[Index, Array]
    """Body that carries each free node (node,), and the node in its native frame (node, 3)."""

    @property
    def count(self) -> int:
        """Number of all nodes."""
        return self.free + len(self.fixed)

    def of_body(self, body: int) -> BodyPoints:
        """Return the nodes of a body by index; −1 is the world."""
        return self.world if body == WORLD_INDEX else self.bodies[body]

    def span(self, bodies: tuple[int, int], places: tuple[Array, Array]) -> Array:
        """Return the nodes' weights in the vector from one body's point to another's, (node,)."""
        start, end = (
            self.of_body(body).weights(place, self.count)
            for body, place in zip(bodies, places, strict=True)
        )
        return end - start


@dataclass(frozen=True, eq=False)
class _Frame:
    """Tips of a body before the nodes are numbered."""

    directions: Array
    distances: Array
    moments: Array

    @property
    def offsets(self) -> Array:
        """Centre of mass and tips in the native frame, shape (1 + tip, 3)."""
        return np.concatenate([np.zeros((1, 3)), self.directions * self.distances[:, None]])


def models_of_points(mechanism: Mechanism) -> tuple[str, ...]:
    """Name the models that replace bodies by points, if these can represent a mechanism."""
    if mechanism.scene.contacts or any(joint.is_loaded for joint in mechanism.joints):
        return ()
    try:
        points_of(mechanism)
    except Unsupported:
        return ()
    return "hgnn", "lgnn"


def points_of(mechanism: Mechanism) -> NodePoints:
    """Choose the points of a mechanism; raise Unsupported for a body without thickness."""
    axes = _rods(mechanism)
    frames = [_frame(mechanism, k, axes[k]) for k in range(mechanism.body_count)]
    first = np.cumsum([0, *(len(frame.offsets) for frame in frames)])
    node, fixed = _nodes(mechanism, frames, first)
    free = int(node.max()) + 1 - len(fixed)
    bodies = tuple(
        BodyPoints(int(nodes[0]), nodes[1:], frame.directions, frame.distances)
        for frame, nodes in zip(frames, np.split(node, first[1:-1]), strict=True)
    )
    count = free + len(fixed)
    mass = np.zeros(count + 4)
    np.add.at(mass, [body.com for body in bodies], mechanism.mass)
    # A node is carried by the body of the first point that became it.
    slot = np.array([int(np.argmax(node == k)) for k in range(free)], dtype=np.int64)
    body_of = np.repeat(np.arange(len(frames)), np.diff(first))
    return NodePoints(
        bodies=bodies,
        world=BodyPoints(count, count + np.arange(1, 4), np.eye(3), np.ones(3)),
        free=free,
        fixed=np.concatenate([fixed, np.zeros((1, 3)), np.eye(3)]),
        mass=mass,
        rods=np.array([(tip, body.com) for body in bodies for tip in body.tips]),
        rod_mass=np.concatenate([frame.moments / frame.distances**2 for frame in frames]),
        rod_length=np.concatenate([frame.distances for frame in frames]),
        carrier=(body_of[slot], np.concatenate([frame.offsets for frame in frames])[slot]),
    )


def _rods(mechanism: Mechanism) -> Array:
    """Return the axes of bodies that never spin and have all particles on the axis; else zero."""
    axes = idle_axes(mechanism.scene).copy()
    off = rotation.cross(axes[mechanism.particle_body], mechanism.particle_offset)
    tolerance = _SAME * mechanism.scene.length
    axes[mechanism.particle_body[np.linalg.norm(off, axis=1) > tolerance]] = 0.0
    axes[mechanism.particles_per_body == 0] = 0.0
    return axes


def kinds_of(points: NodePoints) -> tuple[Index, int]:
    """Return each node's kind, by mass and by whether it is fixed, (node,), and their number."""
    mass = points.mass[: points.count - 3]
    moves = np.arange(len(mass)) < points.free
    kind = distinct(np.stack([mass, moves], axis=1))
    return kind, int(kind.max()) + 1


def distinct(rows: Array) -> Index:
    """Number the distinct rows of a table, shape (row,); rows are equal up to rounding."""
    unit = np.abs(rows).max(axis=0, initial=0.0)
    rounded = np.round(rows / np.where(unit > 0.0, unit, 1.0), _DIGITS)
    _, kind = np.unique(rounded, axis=0, return_inverse=True)
    return kind.reshape(-1).astype(np.int64)


def _frame(mechanism: Mechanism, body: int, idle: Array) -> _Frame:
    """Place a body's tips: on joints that lie on principal axes, else at the radius of gyration."""
    inertia, mass = mechanism.inertia[body], mechanism.mass[body]
    arms = _arms(mechanism, body)
    if idle.any():
        across = (np.trace(inertia) - idle @ inertia @ idle) / 2
        length = np.linalg.norm(arms[0])
        return _Frame((arms[0] / length)[None], np.array([length]), np.array([across]))
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    chosen: list[Array] = []
    for arm in arms:
        _choose(chosen, arm, second, mechanism.scene.length)
    directions = np.array([arm / np.linalg.norm(arm) for arm in chosen]).reshape(-1, 3)
    rest = np.eye(3) - directions.T @ directions
    _, vectors = np.linalg.eigh(rest @ second @ rest + np.trace(second) * (np.eye(3) - rest))
    others = vectors[:, : 3 - len(chosen)].T
    directions = np.concatenate([directions, others])
    moments = np.einsum("ki,ij,kj->k", directions, second, directions)
    if moments.min() < 1e-9 * moments.max():
        raise Unsupported(
            f"body {mechanism.scene.bodies[body].name!r}: got smallest second moment "
            f"{moments.min():.3g} kg·m², allowed is above 0: HGNN and LGNN replace bodies "
            "by points, which have no mass matrix for a flat body; " + instead(mechanism.scene)
        )
    radius = np.sqrt(moments[len(chosen) :] / mass)
    return _Frame(directions, np.array([*map(np.linalg.norm, chosen), *radius]), moments)


def _arms(mechanism: Mechanism, body: int) -> list[Array]:
    """Return the joints of a body that can merge with a tip, in its native frame, tree's first."""
    link = next(link for link in mechanism.links if link.body == body)
    joints = [link.joint] if link.joint else []
    joints += [j for j in mechanism.joints if body in (j.parent, j.child)]
    return [
        joint.in_child if joint.child == body else joint.in_parent
        for joint in joints
        if joint.kind in _MERGING
    ]


def _choose(chosen: list[Array], arm: Array, second: Array, length: float) -> None:
    """Take an arm as a tip if it lies on a principal axis that has none yet."""
    distance = float(np.linalg.norm(arm))
    if distance < 1e-3 * length:
        return
    unit = arm / distance
    off = second @ unit - (unit @ second @ unit) * unit
    free = all(abs(unit @ other) < _SAME * np.linalg.norm(other) for other in chosen)
    if free and np.linalg.norm(off) <= _SAME * np.trace(second):
        chosen.append(arm)


def _nodes(mechanism: Mechanism, frames: list[_Frame], first: Index) -> tuple[Index, Array]:
    """Number the points of all bodies by node, free ones first, and place the fixed ones."""
    group = np.arange(first[-1])
    anchored: dict[int, Array] = {}
    tolerance = _SAME * mechanism.scene.length

    def slot(body: int, point: Array) -> int | None:
        if body == WORLD_INDEX:
            return None
        distance = np.linalg.norm(frames[body].offsets - point, axis=1)
        return int(first[body] + distance.argmin()) if distance.min() <= tolerance else None

    for joint in mechanism.joints:
        if joint.kind not in _MERGING:
            continue
        a, b = slot(joint.parent, joint.in_parent), slot(joint.child, joint.in_child)
        if a is not None and b is not None:
            group[group == group[b]] = group[a]
        end = b if joint.parent == WORLD_INDEX else a
        if end is not None and WORLD_INDEX in (joint.parent, joint.child):
            anchored[end] = joint.anchor
    fixed = {int(group[end]): place for end, place in anchored.items()}
    free = [k for k in dict.fromkeys(group.tolist()) if k not in fixed]
    number = {root: k for k, root in enumerate([*free, *fixed])}
    node = np.array([number[root] for root in group.tolist()], dtype=np.int64)
    return node, np.array(list(fixed.values())).reshape(-1, 3)


_AXES = np.eye(3)
_STARTS = 8
_DEPENDENT = 1e-9
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class PointRows:
    """Coefficients of the constraints (U x) · (W x) = c."""

    first: Array
    """Weights U, shape (row, node)."""
    second: Array
    """Weights W, shape (row, node)."""
    goal: Array
    """Values c [m²], 0 except for lengths; shape (row,)."""
    redundant: int
    """Number of rows that follow from the others. Which rows these are depends on the pose: a hinge
    in a plane loop needs one right angle only, but not the same one at every angle."""


def rows_of(mechanism: Mechanism, points: NodePoints) -> PointRows:
    """Return the rows of rigid bodies, joints and distance links that involve a free node."""
    products = [row for joint in mechanism.joints for row in _coincidence(joint, points)]
    products += [row for body in points.bodies for row in _rigid(body, points.count)]
    products += [row for joint in mechanism.joints for row in _aligned(joint, points)]
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
    """Remove rounding errors: alone in a row, one would act as a constraint."""
    largest = np.abs(weights).max(axis=1, keepdims=True, initial=0.0)
    return np.where(np.abs(weights) > _ROUNDING * largest, weights, 0.0)


def _rigid(body: BodyPoints, count: int) -> list[tuple[Array, Array, float]]:
    """Return the rows for the lengths of a body's axes and the right angles between them."""
    axes = [body.vector(u, count) * d for u, d in zip(body.directions, body.distances, strict=True)]
    return [
        (axes[i], axes[j], float(body.distances[i] ** 2) if i == j else 0.0)
        for i in range(len(axes))
        for j in range(i, len(axes))
    ]


def _coincidence(joint: PlacedJoint, points: NodePoints) -> list[tuple[Array, Array, float]]:
    if joint.kind == "slider":
        return []
    gap = points.span((joint.parent, joint.child), (joint.in_parent, joint.in_child))
    moving = np.abs(gap).max() > _ROUNDING  # weights are of order one
    return [(gap, points.world.vector(axis, points.count), 0.0) for axis in _AXES if moving]


def _aligned(joint: PlacedJoint, points: NodePoints) -> list[tuple[Array, Array, float]]:
    """Return the rows for right angles between vectors of two bodies, and for a slider's line."""
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


def _rank(mechanism: Mechanism, points: NodePoints, first: Array, second: Array) -> int:
    """Return the largest rank of the Jacobian at drawn starts, some of which may be singular."""
    start = draw_batch(mechanism.scene, range(_STARTS), noise=False, inputs=False)
    free = BodyStates.of(mechanism, start).points(*points.carrier)
    fixed = np.broadcast_to(points.fixed, (_STARTS, *points.fixed.shape))
    x = np.concatenate([free, fixed], axis=1)
    product = first[:, :, None] * (second @ x)[:, :, None]
    product += second[:, :, None] * (first @ x)[:, :, None]
    dense = product[:, :, : points.free].reshape(_STARTS, len(first), 3 * points.free)
    dense /= np.linalg.norm(dense, axis=-1, keepdims=True)
    return int(np.linalg.matrix_rank(dense, tol=_DEPENDENT).max()) if dense.size else 0
