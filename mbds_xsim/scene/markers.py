"""Points by which the distance of two motions is measured: particles, or such as stand for them."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.mechanism import Mechanism


def markers(mechanism: Mechanism) -> tuple[Index, Array]:
    """Give the body (marker,) and the offset from its centre of mass in N [m] (marker, 3) of each.

    They are the particles; in a body without any, six points around its centre of mass at its
    mean radius of gyration.
    """
    bare = np.flatnonzero(mechanism.particles_per_body == 0)
    radius = np.sqrt(np.einsum("kii->k", mechanism.inertia[bare]) / (2.0 * mechanism.mass[bare]))
    star = np.concatenate([np.eye(3), -np.eye(3)])
    body = np.concatenate([mechanism.particle_body, np.repeat(bare, len(star))])
    offset = (radius[:, None, None] * star).reshape(-1, 3)
    return body, np.concatenate([mechanism.particle_offset, offset])


def marker_positions(mechanism: Mechanism, position: Array, native: Array) -> Array:
    """Place the markers [m], shape (…, marker, 3), of bodies at positions and turns of N."""
    body, offset = markers(mechanism)
    return position[..., body, :] + rotation.rotate(native[..., body, :], offset)
