"""Bodies of USD Physics: their masses, their collision shapes, and how two of these touch.

Masses are as stated, or from the density of the shapes by the schema's rules. The schema does not
say how two materials combine. Their mean counts here, as in PhysX, for which the schema was made.
Groups and pairs that do not collide follow the schema:
https://openusd.org/release/api/usd_physics_page_front.html
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np

from mbds_xsim.base import bounds, rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError

from .parts import Mass, Pair, Solid

_SHAPES = ("SphereShape", "CubeShape", "CapsuleShape", "CylinderShape", "ConeShape")
_TURNS = {"X": [1, 2, 0], "Y": [2, 0, 1], "Z": [0, 1, 2]}
"""Order of a prim's axes, by the axis of its shape, which comes last."""
_EVEN = 1e-6  # relative difference of scales that may come from single precision


class Stage:
    """A stage, and the objects that the library of OpenUSD finds in it."""

    def __init__(self, stage: Any) -> None:
        from pxr import UsdGeom, UsdPhysics

        self.stage, self.physics = stage, UsdPhysics
        self.metre = UsdGeom.GetStageMetersPerUnit(stage)
        """Length of a unit [m]."""
        self.kilogram = UsdPhysics.GetStageKilogramsPerUnit(stage)
        """Mass of a unit [kg]."""
        bounds.positive("metersPerUnit", self.metre)
        bounds.positive("kilogramsPerUnit", self.kilogram)
        upright = UsdGeom.GetStageUpAxis(stage) == "Z"
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up to z up
        self.up = np.eye(3) if upright else turn
        self._places = UsdGeom.XformCache()
        self._objects = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(stage, ["/"])
        self._count = Counter(prim.GetName() for prim in stage.Traverse())

    def all(self, kind: str) -> list[Any]:
        """Return all objects of a kind."""
        object_type = getattr(self.physics.ObjectType, kind)
        return list(self._objects.get(object_type, ((), ()))[1])

    def name(self, path: Any) -> str:
        """Return the last part of a path if it is unique, or else the whole path."""
        unique = self._count[path.name] == 1
        return path.name if unique else str(path).removeprefix("/").replace("/", " ")

    def frame(self, path: Any) -> tuple[Array, Array]:
        """Return position and axes of a prim in W."""
        if path.isEmpty or str(path) == "/":
            return np.zeros(3), self.up
        matrix = np.array(self._places.GetLocalToWorldTransform(self.stage.GetPrimAtPath(path)))
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=1, keepdims=True)
        return self.up @ matrix[3, :3] * self.metre, self.up @ axes.T


def written(number: float) -> float:
    """Return a number of single precision as the file states it: 0.7 and not 0.69999999."""
    return float(str(np.float32(number)))


def mass_of(stage: Stage, body: Any) -> Mass:
    """Return mass, centre of mass and inertia in the body's frame, in SI units.

    Args:
        stage: The stage.
        body: The body as the library describes it.
    """
    physics, metre, kilogram = stage.physics, stage.metre, stage.kilogram
    prim = stage.stage.GetPrimAtPath(body.primPath)
    api = physics.MassAPI(prim)
    mass, moments = (get().Get() for get in (api.GetMassAttr, api.GetDiagonalInertiaAttr))
    place = api.GetCenterOfMassAttr()
    stated = np.array(place.Get() if place.HasAuthoredValue() else (-np.inf,) * 3, dtype=float)
    centre = stated * np.array(body.scale, dtype=float)
    has_centre, has_moments = np.isfinite(stated).all(), moments is not None and any(moments)
    inertia = np.zeros((3, 3))
    if has_moments:
        axes = api.GetPrincipalAxesAttr()
        inertia = _tensor(moments, matrix_of(axes.Get()) if axes.HasAuthoredValue() else np.eye(3))
    if not body.collisions or (mass and has_moments and has_centre):
        centre = centre if has_centre else np.zeros(3)
        return Mass((mass or 0.0) * kilogram, centre * metre, inertia * kilogram * metre**2)
    shapes = {shape.primPath: (kind, shape) for kind in _SHAPES for shape in stage.all(kind)}

    def solid(shape_prim: Any) -> Any:
        if shape_prim.GetPath() not in shapes:
            raise InputError(
                f"the mass of {body.primPath} depends on the mesh {shape_prim.GetPath()}; state "
                "its mass, diagonalInertia and centerOfMass"
            )
        return _information(physics, *shapes[shape_prim.GetPath()])

    total_mass, moments, centre, axes = physics.RigidBodyAPI(prim).ComputeMassProperties(solid)
    if not has_moments:  # stated ones are along stated axes, not along those of the shapes
        inertia = _tensor(moments, matrix_of(axes))
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


def _tensor(moments: Any, turn: Array) -> Array:
    return np.asarray(turn @ np.diag(np.array(moments, dtype=float)) @ turn.T)


def matrix_of(turn: Any) -> Array:
    """Return the matrix of a rotation in the file; the quaternion 0 is no rotation."""
    quaternion = np.array([turn.GetReal(), *turn.GetImaginary()], dtype=float)
    size = float(np.linalg.norm(quaternion))
    return rotation.matrix(quaternion / size) if size > 0 else np.eye(3)


class Shapes:
    """The collision shapes of a stage."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._materials = {each.primPath: each for each in stage.all("RigidBodyMaterial")}
        self._bodies = {each.primPath: each for each in stage.all("RigidBody")}
        groups = stage.all("CollisionGroup")
        self._groups = {path: g for g in groups for path in (g.primPath, *g.mergedGroups)}

    def solids(self, part: Mapping[Any, int]) -> Iterator[Solid]:
        """Yield the shapes that collide.

        Args:
            part: Indices of moving bodies among the parts, keyed by path.
        """
        for listing in filter(re.compile("Shape$").search, dir(self._stage.physics.ObjectType)):
            kind = listing.removesuffix("Shape").lower().replace("cube", "box")
            for shape in self._stage.all(listing):
                if shape.collisionEnabled:
                    yield self._solid(shape, kind, part.get(shape.rigidBody, -1))

    def _solid(self, shape: Any, kind: str, part: int) -> Solid:
        place, axes = self._stage.frame(shape.primPath)
        order = _TURNS[shape.axis.name if hasattr(shape, "axis") else "Z"]
        even = self._is_even(shape.primPath, kind, order)
        return Solid(
            name=self._stage.name(shape.primPath),
            part=part,
            kind=kind if even else f"{kind}, scaled unevenly",
            size=_size(shape, kind) * self._stage.metre,
            place=place,
            axes=axes[:, order],
            own=shape,
        )

    def _is_even(self, path: Any, kind: str, order: list[int]) -> bool:
        """Whether a shape is still of its kind after scaling."""
        from pxr import UsdGeom

        prim = self._stage.stage.GetPrimAtPath(path)
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))[:3, :3]
        scales = np.linalg.norm(matrix, axis=1)[order]
        unit = matrix[order] / scales[:, None]
        alike = {"sphere": scales, "capsule": scales, "cylinder": scales[:2]}.get(kind, scales[:1])
        skew = np.abs(unit @ unit.T - np.eye(3)).max()
        return bool(max(np.ptp(alike) / scales.max(), skew) < _EVEN)

    def pair(self, shape: Solid, floor: Solid | None) -> Pair:
        """Return how a shape meets the ground; see `parts.Solids`."""
        sides = [each.own for each in (shape, floor) if each is not None]
        friction, restitution = (
            _mean([self._coefficient(side, key) for side in sides])
            for key in ("dynamicFriction", "restitution")
        )
        return Pair(friction, restitution, self._apart(*sides) if floor is not None else "")

    def _coefficient(self, shape: Any, key: str) -> float | None:
        material = next((m for p in shape.materials if (m := self._materials.get(p))), None)
        return None if material is None else written(getattr(material, key))

    def _with_body(self, shape: Any) -> list[Any]:
        body = self._bodies.get(shape.rigidBody)
        return [shape] if body is None else [shape, body]

    def _apart(self, one: Any, other: Any) -> str:
        for first, second in ((one, other), (other, one)):
            # What a path filters includes all prims below it.
            filtered = [p for each in self._with_body(first) for p in each.filteredCollisions]
            paths = [each.primPath for each in self._with_body(second)]
            if any(path.HasPrefix(prefix) for prefix in filtered for path in paths):
                return "filteredPairs keeps it from the ground"
            groups = product(first.collisionGroups, second.collisionGroups)
            if any(self._filters(*pair) for pair in groups):
                return "its collision group does not meet the ground's"
        return ""

    def _filters(self, group: Any, other: Any) -> bool:
        """Whether a collision group does not collide with another."""
        filtered = set(self._groups[group].filteredGroups)
        merged = [self._stage.stage.GetPrimAtPath(path) for path in self._merged_groups(group)]
        # The library calls all groups inverted.
        inverted = any(each.GetAttribute("physics:invertFilteredGroups").Get() for each in merged)
        return bool(filtered & set(self._merged_groups(other))) != inverted

    def _merged_groups(self, group: Any) -> list[Any]:
        """Return the paths of all groups merged with a group, including its own."""
        return [group, *self._groups[group].mergedGroups]


def _size(shape: Any, kind: str) -> Array:
    """Return half-sizes in units of the stage, as `contacts.BALLS` takes them."""
    if kind == "box":
        return np.array(shape.halfExtents, dtype=float)
    if kind in ("sphere", "capsule", "cylinder"):
        return np.array([shape.radius, getattr(shape, "halfHeight", 0.0), 0.0])
    return np.zeros(3)


def _mean(values: list[float | None]) -> float | None:
    stated = [value for value in values if value is not None]
    return sum(stated) / len(stated) if stated else None
