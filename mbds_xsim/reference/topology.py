"""The constant parts of a mechanism's equations of motion, laid out for fast evaluation.

Bodies carry their *principal frame*: at the centre of mass, axes along the principal axes of
inertia. The world is one more body, the last, at rest and without inverse mass, so that no
expression needs a special case for it.

Everything that turns with a body is a *vector* fixed in it (arms of joints, axes, normals), kept in
one list: the evaluation turns all of them at once. *Spans* are pairs of points, one a joint, link
or spring; their first and second ends come first in that list.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_AXES = np.eye(3)


@dataclass(frozen=True, eq=False)
class Topology:
    """Constant arrays; rows come in the order of `mbds_xsim.scene.constraints`."""

    body_count: int
    """Without the world."""
    gravity: Array
    mass_root: Array
    """√m, shape (body + world,); 1 for the world, which `weight` then takes out."""
    inertia_root: Array
    """Roots of the principal moments, shape (body + world, 3)."""
    weight: Array
    """1 for a body, 0 for the world, shape (body + world, 1)."""
    principal: Array
    """Principal to native frame, wxyz, shape (body + world, 4)."""
    vector_body: Indices
    vector: Array
    """In principal frames, shape (vector, 3)."""
    span_body: Indices
    """Of the first and second ends, shape (2, span)."""
    points: slice
    """Spans of the ball, hinge and fixed joints."""
    along: slice
    """Spans of the rows that hold a slider on its line."""
    distances: slice
    springs: slice
    along_normal: slice
    """Vectors: the normals of the slider's line."""
    normal: slice
    """Vectors: the normals n in the parent, then (`lever`) the directions a in the child."""
    lever: slice
    hinge: slice
    """Vectors: the hinges' axes, fixed in the parent."""
    hinge_incidence: Array
    """+1 at the child, −1 at the parent, shape (body + world, hinge)."""
    spring_incidence: Array
    """One matrix an end, shape (2, body + world, spring)."""
    length: Array
    rest_length: Array
    stiffness: Array
    damping: Array
    row_body: Indices
    """Bodies of the two ends of every row, shape (2, row)."""

    sphere_body: Indices
    sphere: Array
    """Centres of the contact spheres in principal frames, shape (sphere, 3)."""
    sphere_radius: Array

    @property
    def row_count(self) -> int:
        """Number of scalar constraints."""
        return self.row_body.shape[1]


class _Vectors:
    """The list of body-fixed vectors while it grows."""

    def __init__(self) -> None:
        self.body: list[int] = []
        self.native: list[Array] = []

    def add(self, items: list[tuple[int, Array]]) -> slice:
        start = len(self.body)
        self.body += [body for body, _ in items]
        self.native += [vector for _, vector in items]
        return slice(start, len(self.body))


_Span = tuple[int, int, Array, Array]


@functools.lru_cache(maxsize=64)
def topology_of(mechanism: Mechanism) -> Topology:
    """Lay out a mechanism (once each)."""
    count = mechanism.body_count
    joints = mechanism.joints
    points = [_joint_span(joint) for joint in joints if joint.kind != "slider"]
    along = [(joint, n) for joint in joints for n in _along_normals(joint)]
    normal = [(joint, a, n) for joint in joints for a, n in _normal_pairs(joint)]
    pairs = [
        [(*pair.bodies, *pair.in_body) for pair in group]
        for group in (mechanism.distances, mechanism.springs)
    ]
    spans: list[_Span] = []
    parts: list[slice] = []
    for group in (points, [_joint_span(joint) for joint, _ in along], *pairs):
        parts.append(slice(len(spans), len(spans) + len(group)))
        spans += group
    vectors = _Vectors()
    vectors.add([(span[0], span[2]) for span in spans])
    vectors.add([(span[1], span[3]) for span in spans])
    slices = [
        vectors.add([(joint.parent, n) for joint, n in along]),
        vectors.add([(joint.parent, n) for joint, _, n in normal]),
        vectors.add([(joint.child, a) for joint, a, _ in normal]),
        vectors.add([(hinge.parent, hinge.axis) for hinge in mechanism.hinges]),
    ]
    ends = np.array([span[:2] for span in spans], dtype=np.intp).reshape(-1, 2).T % (count + 1)
    normal_ends = np.array([(j.parent, j.child) for j, _, _ in normal], dtype=np.intp)
    moments, principal = _principal_axes(mechanism)
    vector_body = np.array(vectors.body, dtype=np.intp) % (count + 1)
    native = np.array(vectors.native, dtype=float).reshape(-1, 3)
    return Topology(
        body_count=count,
        gravity=np.array(mechanism.scene.gravity),
        mass_root=np.sqrt(np.append(mechanism.mass, 1.0)),
        inertia_root=np.sqrt(moments),
        weight=np.append(np.ones(count), 0.0)[:, None],
        principal=principal,
        vector_body=vector_body,
        vector=rotation.rotate(rotation.conjugate(principal[vector_body]), native),
        span_body=ends,
        points=parts[0],
        along=parts[1],
        distances=parts[2],
        springs=parts[3],
        along_normal=slices[0],
        normal=slices[1],
        lever=slices[2],
        hinge=slices[3],
        hinge_incidence=_incidence([j.child for j in mechanism.hinges], count)
        - _incidence([j.parent for j in mechanism.hinges], count),
        spring_incidence=np.array(
            [_incidence([s.bodies[end] for s in mechanism.springs], count) for end in (0, 1)]
        ),
        length=np.array([link.length for link in mechanism.distances]),
        rest_length=np.array([spring.length for spring in mechanism.springs]),
        stiffness=np.array([spring.stiffness for spring in mechanism.springs]),
        damping=np.array([spring.damping for spring in mechanism.springs]),
        row_body=np.concatenate(
            [
                np.repeat(ends[:, parts[0]], 3, axis=1),
                ends[:, parts[1]],
                normal_ends.reshape(-1, 2).T % (count + 1),
                ends[:, parts[2]],
            ],
            axis=1,
        ),
        sphere_body=mechanism.sphere_body.astype(np.intp),
        sphere=rotation.rotate(
            rotation.conjugate(principal[mechanism.sphere_body]), mechanism.sphere_offset
        ),
        sphere_radius=mechanism.sphere_radius,
    )


def _joint_span(joint: PlacedJoint) -> _Span:
    return joint.parent, joint.child, joint.in_parent, joint.in_child


def _along_normals(joint: PlacedJoint) -> tuple[Array, ...]:
    return rotation.normal_to(joint.axis) if joint.kind == "slider" else ()


def _normal_pairs(joint: PlacedJoint) -> list[tuple[Array, Array]]:
    """Directions (a in the child, n in the parent) that stay at right angles."""
    if joint.kind == "hinge":
        return [(joint.axis, n) for n in rotation.normal_to(joint.axis)]
    if joint.kind == "ball":
        return []
    return [(_AXES[k], _AXES[(k + 1) % 3]) for k in range(3)]


def _principal_axes(mechanism: Mechanism) -> tuple[Array, Array]:
    """Principal moments (body + world, 3) and frames (body + world, 4)."""
    moments, axes = np.linalg.eigh(mechanism.inertia)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1.0
    principal = rotation.from_matrix(axes)
    return (
        np.concatenate([moments, np.ones((1, 3))]),
        np.concatenate([principal, rotation.IDENTITY[None]]),
    )


def _incidence(bodies: list[int], count: int) -> Array:
    matrix = np.zeros((count + 1, len(bodies)))
    matrix[[body % (count + 1) for body in bodies], range(len(bodies))] = 1.0
    return matrix
