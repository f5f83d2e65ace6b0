"""Masses of USD bodies: as stated, or from the density of their shapes by the schema's rules."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError

from .parts import Mass

_SHAPES = ("SphereShape", "CubeShape", "CapsuleShape", "CylinderShape", "ConeShape")


def mass_of(
    prim: Any, shapes_of: Callable[[str], list[Any]], body: Any, metre: float, kilogram: float
) -> Mass:
    """Return mass, centre of mass and inertia in the body's frame, in SI units.

    Args:
        prim: Prim of the body.
        shapes_of: Returns all shapes of a kind.
        body: The body as the library describes it.
        metre: Length of a unit [m].
        kilogram: Mass of a unit [kg].
    """
    from pxr import UsdPhysics

    api = UsdPhysics.MassAPI(prim)
    mass, moments = (get().Get() for get in (api.GetMassAttr, api.GetDiagonalInertiaAttr))
    place = api.GetCenterOfMassAttr()
    stated = np.array(place.Get() if place.HasAuthoredValue() else (-np.inf,) * 3, dtype=float)
    centre = stated * np.array(body.scale, dtype=float)
    has_centre, has_moments = np.isfinite(stated).all(), moments is not None and any(moments)
    inertia = _tensor(moments, api.GetPrincipalAxesAttr()) if has_moments else np.zeros((3, 3))
    if not body.collisions or (mass and has_moments and has_centre):
        centre = centre if has_centre else np.zeros(3)
        return Mass((mass or 0.0) * kilogram, centre * metre, inertia * kilogram * metre**2)
    shapes = {shape.primPath: (kind, shape) for kind in _SHAPES for shape in shapes_of(kind)}

    def solid(shape_prim: Any) -> Any:
        if shape_prim.GetPath() not in shapes:
            raise InputError(
                f"the mass of {body.primPath} depends on the mesh {shape_prim.GetPath()}; state "
                "its mass, diagonalInertia and centerOfMass"
            )
        return _information(UsdPhysics, *shapes[shape_prim.GetPath()])

    total_mass, moments, centre, axes = UsdPhysics.RigidBodyAPI(prim).ComputeMassProperties(solid)
    if not has_moments:  # stated ones are along stated axes, not along those of the shapes
        turn = matrix_of(axes)
        inertia = turn @ np.diag(np.array(moments, dtype=float)) @ turn.T
    centre = np.array(centre, dtype=float)
    return Mass(total_mass * kilogram, centre * metre, inertia * kilogram * metre**2)


def _information(physics: Any, kind: str, shape: Any) -> Any:
    """Return volume, and inertia at unit density about the centre of mass, of a shape."""
    from pxr import Gf

    volume, moments, centre = _solid(kind, shape)
    if kind in ("CapsuleShape", "CylinderShape", "ConeShape"):  # computed along z
        order = {"X": [2, 1, 0], "Y": [0, 2, 1], "Z": [0, 1, 2]}[shape.axis.name]
        moments, centre = moments[order], centre[order]
    information = physics.RigidBodyAPI.MassInformation()
    information.volume = volume
    information.inertia = Gf.Matrix3f(*np.diag(moments).ravel().tolist())
    information.centerOfMass = Gf.Vec3f(*centre.tolist())
    information.localPos, information.localRot = shape.localPos, shape.localRot
    return information


def _solid(kind: str, shape: Any) -> tuple[float, Array, Array]:
    """Return volume, moments about x, y and z, and centre of mass of a solid of density 1."""
    if kind == "CubeShape":
        a, b, c = (2 * float(half) for half in shape.halfExtents)
        volume = a * b * c
        sides = np.array([b * b + c * c, a * a + c * c, a * a + b * b])
        return volume, volume / 12 * sides, np.zeros(3)
    r = float(shape.radius)
    if kind == "SphereShape":
        volume = 4 / 3 * np.pi * r**3
        return volume, np.full(3, 0.4 * volume * r * r), np.zeros(3)
    h = 2 * float(shape.halfHeight)
    volume = np.pi * r * r * h
    if kind == "CylinderShape":
        across = volume * (3 * r * r + h * h) / 12
        return volume, np.array([across, across, volume * r * r / 2]), np.zeros(3)
    if kind == "ConeShape":  # tip up; the centre of mass is a quarter of the way up
        volume /= 3
        across = volume * (3 / 20 * r * r + 3 / 80 * h * h)
        return volume, np.array([across, across, 0.3 * volume * r * r]), np.array([0, 0, -h / 4])
    ball = 4 / 3 * np.pi * r**3
    across = volume * (3 * r * r + h * h) / 12
    across += ball * (0.4 * r * r + h * h / 4 + 3 / 8 * h * r)
    along = volume * r * r / 2 + 0.4 * ball * r * r
    return volume + ball, np.array([across, across, along]), np.zeros(3)


def _tensor(moments: Any, axes: Any) -> Array:
    turn = matrix_of(axes.Get()) if axes.HasAuthoredValue() else np.eye(3)
    return np.asarray(turn @ np.diag(np.array(moments, dtype=float)) @ turn.T)


def matrix_of(turn: Any) -> Array:
    """Return the matrix of a rotation in the file; the quaternion 0 is no rotation."""
    quaternion = np.array([turn.GetReal(), *turn.GetImaginary()], dtype=float)
    size = float(np.linalg.norm(quaternion))
    return rotation.matrix(quaternion / size) if size > 0 else np.eye(3)
