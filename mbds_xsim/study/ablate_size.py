"""The native model's size beside the smallest that could do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim import rotation
from mbds_xsim.constraints import constraint_rows, degrees_of_freedom, dense_jacobian
from mbds_xsim.engine import ModelSize, Settings
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.registry import load_adapter
from mbds_xsim.scene import Scene
from mbds_xsim.study.ablate_result import Size

__all__ = ["Least", "compared", "least_size", "native_size"]

_FREEDOMS = {"fixed": 0, "hinge": 1, "slider": 1, "ball": 3}
_FREE = 6
_IN_LINE, _IN_PLANE = (0, 4), (0, 2, 4)
"""Coordinates of a body that moves along x and rolls, or in x and z and turns about y."""


@dataclass(frozen=True)
class Least:
    """The smallest model of a scene."""

    degrees_of_freedom: int
    coordinates: int
    """Of the spanning tree; in one and two dimensions the degrees of freedom."""
    conditions: int
    """Independent conditions of the loops."""
    spheres: int


def least_size(scene: Scene) -> Least:
    """Count what a model cannot do without."""
    mechanism = Mechanism.of(scene)
    if scene.dimension < 3:
        freedom = _planar_freedom(mechanism, _IN_LINE if scene.dimension == 1 else _IN_PLANE)
        return Least(freedom, freedom, 0, len(scene.contacts))
    freedom = degrees_of_freedom(mechanism)
    tree = [link.joint for link in mechanism.links]
    coordinates = sum(_FREE if joint is None else _FREEDOMS[joint.kind] for joint in tree)
    return Least(freedom, coordinates, coordinates - freedom, len(scene.contacts))


def native_size(scene: Scene, engine: str, settings: Settings) -> ModelSize:
    """Load a scene and tell the size of the engine's model."""
    with load_adapter(engine).open(scene, settings) as run:
        return run.size


def compared(engine: str, size: ModelSize, least: Least) -> Size:
    """Tell what a model has more than the smallest."""
    return Size(
        engine=engine,
        coordinates=size.coordinates,
        constraints=size.constraints,
        contact_pairs=size.contact_pairs,
        more_coordinates=size.coordinates - least.coordinates,
        more_constraints=size.constraints - least.conditions,
        more_pairs=size.contact_pairs - least.spheres,
    )


def _planar_freedom(mechanism: Mechanism, moving: tuple[int, ...]) -> int:
    """Degrees of freedom at the reference pose of bodies that move in some coordinates only."""
    count = mechanism.body_count
    still = np.zeros((count, 3))
    native = np.broadcast_to(rotation.IDENTITY, (count, 4))
    rows = constraint_rows(mechanism, mechanism.com, native, still, still)
    if not len(rows.parent):
        return len(moving) * count
    columns = [6 * body + k for body in range(count) for k in moving]
    jacobian = dense_jacobian(rows, count)[:, columns]
    return len(columns) - int(np.linalg.matrix_rank(jacobian, rtol=1e-9))
