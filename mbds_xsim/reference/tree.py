"""Constant arrays of a mechanism for the compiled kernels, link by link, and its coordinates."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.reference.elimination import Elimination, plan_of
from mbds_xsim.reference.topology import topology_of
from mbds_xsim.scene.constraints import layout_of
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate, to_links
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint

FIXED, HINGE, SLIDER, BALL, FREE = range(5)
_KINDS = {"fixed": FIXED, "hinge": HINGE, "slider": SLIDER, "ball": BALL}
_PLACES, _SPEEDS = (0, 2, 1, 4, 7), (0, 1, 1, 3, 6)

ALONG, NORMAL, DISTANCE, COUPLED = range(4)


class ClosureRows(NamedTuple):
    """Rows that close loops or couple joints."""

    kind: Index
    ends: Index
    """Links of the two ends of each row, shape (row, 2)."""
    points: Array
    """Vectors fixed in the first and in the second link of each row, shape (row, 2, 3)."""
    way: Array
    """Direction of the row, fixed in the first link, or zeros, shape (row, 3). For a coupling,
    whose ends are the follower's and the leader's link: 1, −ratio and 0."""
    length: Array
    """Length of a distance link [m], or offset of a coupling."""
    place: Index
    """Indices in a state of the coordinates of a coupling, shape (row, 2); 0 for other rows."""


class Tree(NamedTuple):
    """A mechanism's links, in the order of `Mechanism.links`, followed by the world."""

    kind: Index
    parent: Index
    body: Index
    """Index in the scene of each link's body."""
    at: Index
    """Index in a state of each link's first coordinate."""
    speed_at: Index
    """Index in a state of each link's first speed, and the end of the last ones, (link + 1,)."""
    place_count: int
    size: int
    """Number of coordinates and speeds in a state."""
    in_parent: Array
    """Arms to joints in the parents' principal frames, (link, 3); `in_child`: in the children's."""
    in_child: Array
    axis: Array
    """Axes of the joints in the parents' frames."""
    fixed: Array
    """Matrices from the child's to the parent's frame for a joint at 0, shape (link, 9)."""
    odd: Array
    """Matrices that hinges add to `fixed`, times the sine of their angle."""
    even: Array
    """Matrices that hinges add to `fixed`, times 1 − cosine of their angle."""
    still: Array
    """`fixed` as a quaternion, shape (link, 4)."""
    mass: Array
    armature: Array
    """Armature of the links' joints, shape (link,)."""
    moment: Array
    """Principal moments, shape (link, 3)."""
    yielding: Array
    """Inverse masses and mean inverse moments, 0 for the world, shape (link + 1, 2)."""
    gravity: Array
    hinge_ends: Index
    """Links of the parents and children that torques act on, shape (2, hinge)."""
    hinge_axis: Array
    """Axes in the parents' frames, shape (hinge, 3)."""
    spring_ends: Index
    spring_points: Array
    """Points in the frames of the two ends, shape (2, spring, 3)."""
    spring: Array
    """Rest length, stiffness and damping, shape (spring, 3)."""
    law_kind: Index
    """`HINGE` or `SLIDER` for `Mechanism.counted` and then for the drives' joints."""
    law_ends: Index
    law_axis: Array
    """Axes in the parents' frames, shape (law, 3)."""
    law_points: Array
    """Anchors in the frames of the two ends, shape (2, law, 3)."""
    law: Array
    """Coordinate at rest, stiffness and damping, shape (law, 3)."""
    pushed: Index
    """Index in the inputs of a drive's push, after the torques of hinges; −1 if not a drive."""
    bound: Array
    """Limits of drives, infinite for other laws, shape (law,)."""
    angle_at: Index
    """Index in a state of each hinge's angle; −1 for sliders, shape (law,). Angles count whole
    turns, and follow the links' coordinates."""
    angle_link: Index
    """Links of coupled hinges; −1 for other laws, shape (law,)."""
    row: ClosureRows
    loaded: int
    """Number of rows that carry loads; the rows after them follow from them."""
    plan: Elimination
    """Plan to eliminate the rows that carry loads."""


@functools.lru_cache(maxsize=64)
def tree_of(mechanism: Mechanism) -> Tree:
    """Lay out a mechanism, with its closure rows in the scene's order (once each)."""
    top, links = topology_of(mechanism), mechanism.links
    world = len(links)
    body = np.array([link.body for link in links])
    link_of = np.append(np.argsort(body), world)  # −1 finds the world
    kind = np.array([FREE if link.joint is None else _KINDS[link.joint.kind] for link in links])
    parent_body = np.array([link.parent for link in links])
    inwards = rotation.conjugate(top.principal)
    places, speeds = np.array(_PLACES)[kind], np.array(_SPEEDS)[kind]
    matrices = [_joint_matrices(link.joint) for link in links]
    left, right = rotation.matrix(inwards[parent_body]), rotation.matrix(top.principal[body])
    fixed, odd, even = (
        (left @ np.array([m[k] for m in matrices]) @ right).reshape(-1, 9) for k in range(3)
    )

    def joint_vectors(key: str, frame: Array) -> Array:
        vectors = [np.zeros(3) if x.joint is None else getattr(x.joint, key) for x in links]
        return rotation.rotate(frame, np.array(vectors))

    yielding = np.mean(1.0 / top.inertia_root[body] ** 2, axis=1)
    place_count = int(places.sum()) + sum(j.kind == "hinge" for j in mechanism.counted)
    at = np.cumsum(places) - places
    acting = _acting(mechanism, inwards, link_of, int(places.sum()))
    rows, more = _rows(mechanism, inwards, link_of), _coupled(mechanism, at, acting["angle_at"])
    row = ClosureRows._make(map(np.concatenate, zip(rows, more, strict=True)))
    return Tree(
        kind=kind,
        parent=link_of[parent_body],
        body=body,
        at=at,
        speed_at=place_count + np.cumsum([0, *speeds]),
        place_count=place_count,
        size=int(place_count + speeds.sum()),
        in_parent=joint_vectors("in_parent", inwards[parent_body]),
        in_child=joint_vectors("in_child", inwards[body]),
        axis=joint_vectors("axis", inwards[parent_body]),
        fixed=fixed,
        odd=odd,
        even=even,
        still=rotation.multiply(inwards[parent_body], top.principal[body]),
        mass=mechanism.mass[body],
        armature=np.array([0.0 if x.joint is None else x.joint.armature for x in links]),
        moment=top.inertia_root[body] ** 2,
        yielding=np.array([*zip(1.0 / mechanism.mass[body], yielding, strict=True), (0.0, 0.0)]),
        gravity=top.gravity,
        spring=top.spring,
        **acting,
        row=row,
        loaded=len(row.kind),
        plan=plan_of(link_of[parent_body], speeds, row.ends, row.kind == COUPLED, keep_all=True),
    )


def with_rows(tree: Tree, order: Index, loaded: int) -> Tree:
    """Order the closure rows; the first `loaded` carry loads and are eliminated."""
    row, speeds = ClosureRows._make(each[order] for each in tree.row), np.diff(tree.speed_at)
    plan = plan_of(tree.parent, speeds, row.ends[:loaded], row.kind[:loaded] == COUPLED)
    return tree._replace(row=row, loaded=loaded, plan=plan)


def to_tree(mechanism: Mechanism, bodies: BodyStates, states: Array) -> Array:
    """Coordinates and speeds of states in a mechanism's tree, shape (batch, number).

    Args:
        mechanism: Mechanism with that tree.
        bodies: States of the bodies.
        states: The same states in the reference's layout, shape (batch, body + world, 13).
    """
    tree = tree_of(mechanism)
    single = np.isin(tree.kind, (HINGE, SLIDER)).any()
    links = to_links(mechanism, bodies) if single else None
    y = np.zeros((len(states), tree.size))
    for k, (kind, body) in enumerate(zip(tree.kind, tree.body, strict=True)):
        at, fast = tree.at[k], tree.speed_at[k]
        if kind == FREE:
            y[:, at : at + 7], y[:, fast : fast + 6] = states[:, body, :7], states[:, body, 7:]
        elif kind == BALL:
            y[:, at : at + 4], y[:, fast : fast + 3] = states[:, body, 3:7], states[:, body, 10:]
        elif links is None:
            continue
        elif kind == HINGE:
            half = 0.5 * links.coordinate[:, k]
            y[:, at], y[:, at + 1], y[:, fast] = np.cos(half), np.sin(half), links.rate[:, k]
        elif kind == SLIDER:
            y[:, at], y[:, fast] = links.coordinate[:, k], links.rate[:, k]
    for joint, at in zip(mechanism.counted, tree.angle_at, strict=False):  # drives follow
        if at >= 0:
            y[:, at] = joint_coordinate(joint, bodies.position, bodies.native)
    return y


def _acting(mechanism: Mechanism, inwards: Array, link_of: Index, first: int) -> dict[str, Any]:
    """Lay out what acts on bodies; counted angles stand in a state from index `first` on."""
    hinges, springs, counted = mechanism.hinges, mechanism.springs, mechanism.counted
    drives = mechanism.drives
    laws = (*counted, *(drive.joint for drive in drives))
    turning = np.array([joint.kind == "hinge" for joint in counted], dtype=np.int64)
    angle_at = np.where(turning, first + np.cumsum(turning) - 1, -1)
    own = np.array([counted.index(drive.joint) for drive in drives], dtype=np.int64)
    none = np.full(len(counted), -1)
    return dict(
        hinge_ends=_ends([(h.parent, h.child) for h in hinges], link_of),
        hinge_axis=_turned(inwards, [(h.parent, h.axis) for h in hinges]),
        spring_ends=_ends([spring.bodies for spring in springs], link_of),
        spring_points=_points(inwards, [[*zip(s.bodies, s.in_body, strict=True)] for s in springs]),
        law_kind=np.array([_KINDS[joint.kind] for joint in laws], dtype=np.int64),
        law_ends=_ends([(joint.parent, joint.child) for joint in laws], link_of),
        law_axis=_turned(inwards, [(joint.parent, joint.axis) for joint in laws]),
        law_points=_points(
            inwards, [[(j.parent, j.in_parent), (j.child, j.in_child)] for j in laws]
        ),
        law=np.array(
            [(j.rest, j.stiffness, j.damping) for j in counted]
            + [(0.0, drive.servo.stiffness, drive.servo.damping) for drive in drives]
        ).reshape(-1, 3),
        pushed=np.concatenate([none, len(hinges) + np.arange(len(drives))]),
        bound=np.array([np.inf for _ in counted] + [drive.limit for drive in drives]),
        angle_at=np.concatenate([angle_at, angle_at[own]]),
        angle_link=np.array(
            [link_number(mechanism, j) if j.coupled and j.kind == "hinge" else -1 for j in counted]
            + [-1 for _ in drives],
            dtype=np.int64,
        ),
    )


def _joint_matrices(joint: PlacedJoint | None) -> tuple[Array, Array, Array]:
    """Constant, sine and 1 − cosine parts of a joint's rotation matrix in native frames."""
    if joint is None or joint.kind != "hinge":
        return np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))
    x, y, z = joint.axis
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3), across, across @ across


def _ends(pairs: list[tuple[int, int]], link_of: Index) -> Index:
    return np.ascontiguousarray(link_of[np.array(pairs, dtype=np.int64).reshape(-1, 2).T])


def _points(inwards: Array, pairs: list[list[tuple[int, Array]]]) -> Array:
    """Turn pairs of vectors from native into principal frames, shape (2, pair, 3)."""
    return np.stack([_turned(inwards, [pair[end] for pair in pairs]) for end in (0, 1)])


def _turned(inwards: Array, vectors: list[tuple[int, Array]]) -> Array:
    """Turn vectors from native into principal frames."""
    body = np.array([body for body, _ in vectors], dtype=np.int64)
    native = np.array([vector for _, vector in vectors], dtype=float).reshape(-1, 3)
    return rotation.rotate(inwards[body], native)


def _rows(mechanism: Mechanism, inwards: Array, link_of: Index) -> ClosureRows:
    """Rows of the joints and links that close loops, as in `mbds_xsim.scene.constraints`.

    Rows that hold points together lie along axes of the first body and not of W, so that the choice
    of independent rows does not depend on how a mechanism has turned.
    """
    layout = layout_of(mechanism)
    spans = layout.span_body.shape[1]
    turned = rotation.rotate(inwards[layout.vector_body], layout.vector)
    arms = np.stack([turned[:spans], turned[spans : 2 * spans]], axis=1)
    joined, lever, far = arms[layout.points], turned[layout.lever], arms[layout.distances]
    blocks: list[tuple[int, Array, Array]] = [
        (ALONG, np.repeat(joined, 3, axis=0), np.tile(np.eye(3), (len(joined), 1))),
        (ALONG, arms[layout.along], turned[layout.along_normal]),
        (NORMAL, np.stack([np.zeros_like(lever), lever], axis=1), turned[layout.normal]),
        (DISTANCE, far, np.zeros((len(far), 3))),
    ]
    count = layout.row_count
    whole = ClosureRows(
        kind=np.repeat([kind for kind, *_ in blocks], [len(points) for _, points, _ in blocks]),
        ends=np.ascontiguousarray(link_of[layout.row_body].T),
        points=np.concatenate([points for _, points, _ in blocks]),
        way=np.concatenate([way for *_, way in blocks]),
        length=np.append(np.zeros(count - len(far)), layout.length),
        place=np.zeros((count, 2), dtype=np.int64),
    )
    tree = [link.joint.index for link in mechanism.links if link.joint is not None]
    closing = ~np.isin(layout.owner, tree)
    return ClosureRows._make(each[closing] for each in whole)


def _coupled(mechanism: Mechanism, at: Index, angle_at: Index) -> ClosureRows:
    """Return the rows of couplings, whose points are zero."""
    count, places = len(mechanism.couplings), {}
    for joint, angle in zip(mechanism.counted, angle_at.tolist(), strict=False):
        if joint.coupled:  # others may close loops and hold no link
            places[joint.name] = angle if angle >= 0 else int(at[link_number(mechanism, joint)])
    pairs = [(each.follower, each.leader) for each in mechanism.couplings]
    ends = [[link_number(mechanism, joint) for joint in pair] for pair in pairs]
    indices = [[places[joint.name] for joint in pair] for pair in pairs]
    return ClosureRows(
        kind=np.full(count, COUPLED),
        ends=np.array(ends, dtype=np.int64).reshape(-1, 2),
        points=np.zeros((count, 2, 3)),
        way=np.array([(1.0, -each.ratio, 0.0) for each in mechanism.couplings]).reshape(-1, 3),
        length=np.array([each.offset for each in mechanism.couplings]),
        place=np.array(indices, dtype=np.int64).reshape(-1, 2),
    )


def link_number(mechanism: Mechanism, joint: PlacedJoint) -> int:
    """Return the number of the link that a joint of the tree holds."""
    joints = [None if link.joint is None else link.joint.index for link in mechanism.links]
    return joints.index(joint.index)
