"""Mass properties of a body at the reference pose, and tensors of bodies of revolution."""

from __future__ import annotations

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.scene import Body, Inertia


def mass_properties(body: Body) -> tuple[float, Array, Array]:
    """Return a body's mass [kg], centre of mass in W [m] and inertia about it in W [kg·m²]."""
    turn = rotation.matrix(np.array(body.orientation))
    if body.inertia is not None:
        (xx, yy, zz), (xy, xz, yz) = body.inertia.moments, body.inertia.products
        local = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return (
            body.inertia.mass,
            np.array(body.position) + turn @ np.array(body.inertia.com),
            turn @ local @ turn.T,
        )
    masses = np.array([particle.mass for particle in body.particles])
    points = np.array([particle.position for particle in body.particles])
    com = masses @ points / masses.sum()
    arms = points - com
    # Parallel axes: each particle keeps its own isotropic inertia.
    tensor = (
        np.eye(3) * (masses @ np.sum(arms**2, axis=1) + sum(p.inertia for p in body.particles))
        - (arms.T * masses) @ arms
    )
    low, high = np.linalg.eigvalsh(tensor)[[0, 2]]
    if not high > 0 or low < 1e-9 * high:
        raise SceneError(
            f"bodies[{body.name!r}].particles: got smallest principal inertia {low:.3g} kg·m², "
            "allowed is above 0: give a particle an inertia, or the body particles off one line"
        )
    return float(masses.sum()), np.array(body.position) + turn @ com, turn @ tensor @ turn.T


def with_mass_properties(body: Body, mass: float, com: Array, tensor: Array) -> Body:
    """Replace what `mass_properties` returns; a body of particles has none of them any more."""
    turn = rotation.matrix(np.array(body.orientation))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (turn.T @ tensor @ turn).tolist()
    x, y, z = (turn.T @ (com - np.array(body.position))).tolist()
    inertia = Inertia(float(mass), (xx, yy, zz), (xy, xz, yz), (x, y, z))
    return msgspec.structs.replace(body, particles=(), inertia=inertia)


def of_revolution(inertia: Array, axis: Array) -> tuple[float, float, float]:
    """Compare a tensor with that of a body of revolution about an axis through its centre.

    Returns:
        Moment about the axis, mean moment across it, and the largest deviation of an element from
        the tensor of revolution with these moments [kg·m²].
    """
    along = float(axis @ inertia @ axis)
    across = (float(np.trace(inertia)) - along) / 2
    even = across * np.eye(3) + (along - across) * np.outer(axis, axis)
    return along, across, float(np.abs(inertia - even).max())
