"""The constant parts of a mechanism's equations of motion, laid out for fast evaluation.

Bodies carry their *principal frame*: at the centre of mass, axes along the principal axes of
inertia. The world is one more body, the last, at rest and without inverse mass, so that no
expression needs a special case for it.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Indices
from mbds_xsim.scene.constraints import Layout, layout_of
from mbds_xsim.scene.fixed import fixed_spheres
from mbds_xsim.scene.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Topology:
    """Constant arrays of one mechanism."""

    layout: Layout
    """Layout of the constraints, with vectors in principal frames and the world as last body."""
    body_count: int
    """Number of bodies without the world."""
    gravity: Array
    mass_root: Array
    """√m, shape (body + world,); 1 for the world, which `weight` then removes."""
    inertia_root: Array
    """Roots of the principal moments, shape (body + world, 3)."""
    weight: Array
    """1 for a body, 0 for the world, shape (body + world, 1)."""
    principal: Array
    """Rotation from principal to native frame, wxyz, shape (body + world, 4)."""
    hinge_incidence: Array
    """+1 at the child, −1 at the parent, shape (body + world, hinge)."""
    spring_incidence: Array
    """One incidence matrix for each end, shape (2, body + world, spring)."""
    spring: Array
    """Rest length, stiffness and damping, shape (spring, 3)."""
    sphere: Array
    """Centres of the contact spheres in principal frames, shape (sphere, 3)."""
    grounded: Indices
    """Spheres that may touch the ground."""


@functools.lru_cache(maxsize=64)
def topology_of(mechanism: Mechanism) -> Topology:
    """Lay out a mechanism (once each)."""
    count, layout, scene = mechanism.body_count, layout_of(mechanism), mechanism.scene
    moments, principal = _principal_axes(mechanism)
    back = rotation.conjugate(principal)
    hinges, springs = mechanism.hinges, mechanism.springs
    return Topology(
        layout=dataclasses.replace(
            layout,
            vector_body=layout.vector_body % (count + 1),
            vector=rotation.rotate(back[layout.vector_body], layout.vector),
            span_body=layout.span_body % (count + 1),
            row_body=layout.row_body % (count + 1),
        ),
        body_count=count,
        gravity=np.array(scene.gravity),
        mass_root=np.sqrt(np.append(mechanism.mass, 1.0)),
        inertia_root=np.sqrt(moments),
        weight=np.append(np.ones(count), 0.0)[:, None],
        principal=principal,
        hinge_incidence=_incidence([joint.child for joint in hinges], count)
        - _incidence([joint.parent for joint in hinges], count),
        spring_incidence=np.array(
            [_incidence([spring.bodies[end] for spring in springs], count) for end in (0, 1)]
        ),
        spring=np.array([(s.length, s.stiffness, s.damping) for s in springs]).reshape(-1, 3),
        sphere=rotation.rotate(back[mechanism.sphere_body], mechanism.sphere_offset),
        grounded=np.setdiff1d(
            np.arange(len(scene.contacts) if scene.ground else 0), fixed_spheres(scene)
        ),
    )


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
