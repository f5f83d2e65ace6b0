"""Markers: points that measure the distance of two motions, particles or their substitutes."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.mechanism import Mechanism


def markers(mechanism: Mechanism) -> tuple[Index, Array]:
    """Return each marker's body (marker,) and offset from its centre of mass in N [m] (marker, 3).

    Markers are the particles; in a body without any, they are six points around its centre of mass
    at its mean radius of gyration.
    """
    bare = np.flatnonzero(mechanism.particles_per_body == 0)
    radius = np.sqrt(np.einsum("kii->k", mechanism.inertia[bare]) / (2.0 * mechanism.mass[bare]))
    star = np.concatenate([np.eye(3), -np.eye(3)])
    body = np.concatenate([mechanism.particle_body, np.repeat(bare, len(star))])
    offset = (radius[:, None, None] * star).reshape(-1, 3)
    return body, np.concatenate([mechanism.particle_offset, offset])


def marker_positions(mechanism: Mechanism, position: Array, native: Array) -> Array:
    """Return markers in W [m], shape (…, marker, 3), from body positions and rotations of N."""
    body, offset = markers(mechanism)
    return position[..., body, :] + rotation.rotate(native[..., body, :], offset)
