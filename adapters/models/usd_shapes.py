"""Collision shapes of USD Physics, and how two of them touch.

The schema does not say how two materials combine. Their mean counts here, as in PhysX, for which
the schema was made. Groups and pairs that do not collide follow the schema:
https://openusd.org/release/api/usd_physics_page_front.html
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array

from .parts import Pair, Solid

_TURNS = {"X": [1, 2, 0], "Y": [2, 0, 1], "Z": [0, 1, 2]}
"""Order of a prim's axes, by the axis of its shape, which comes last."""
_EVEN = 1e-6  # relative difference of scales that may come from single precision


@dataclass(frozen=True, eq=False)
class Touch:
    """Contact properties of a shape."""

    paths: tuple[Any, ...]
    """Paths of the shape and of its body."""
    filtered: tuple[Any, ...]
    """Paths that neither collides with, including all prims below them."""
    groups: tuple[Any, ...]
    friction: float | None
    restitution: float | None


class Shapes:
    """The collision shapes of a stage.

    Args:
        stage: The stage.
        objects_of: Returns all objects of a kind that the library finds.
        frame: Returns position and axes of a prim in W.
        name: Returns the name of a prim.
        metre: Length of a unit [m].
    """

    def __init__(
        self,
        stage: Any,
        objects_of: Callable[[str], list[Any]],
        frame: Callable[[Any], tuple[Array, Array]],
        name: Callable[[Any], str],
        metre: float,
    ) -> None:
        self._stage, self._objects_of = stage, objects_of
        self._frame, self._name, self._metre = frame, name, metre
        self._materials = {each.primPath: each for each in objects_of("RigidBodyMaterial")}
        self._bodies = {each.primPath: each for each in objects_of("RigidBody")}
        groups = objects_of("CollisionGroup")
        self._groups = {path: g for g in groups for path in (g.primPath, *g.mergedGroups)}

    def solids(self, part: Mapping[Any, int]) -> Iterator[Solid]:
        """Yield the shapes that collide.

        Args:
            part: Indices of moving bodies among the parts, keyed by path.
        """
        from pxr import UsdPhysics

        for listing in filter(re.compile("Shape$").search, dir(UsdPhysics.ObjectType)):
            kind = listing.removesuffix("Shape").lower().replace("cube", "box")
            for shape in self._objects_of(listing):
                if shape.collisionEnabled:
                    yield self._solid(shape, kind, part.get(shape.rigidBody, -1))

    def _solid(self, shape: Any, kind: str, part: int) -> Solid:
        place, axes = self._frame(shape.primPath)
        order = _TURNS[shape.axis.name if hasattr(shape, "axis") else "Z"]
        even = self._is_even(shape.primPath, kind, order)
        return Solid(
            name=self._name(shape.primPath),
            part=part,
            kind=kind if even else f"{kind}, scaled unevenly",
            size=_size(shape, kind) * self._metre,
            place=place,
            axes=axes[:, order],
            own=self._touch(shape),
        )

    def _is_even(self, path: Any, kind: str, order: list[int]) -> bool:
        """Whether a shape is still of its kind after scaling."""
        from pxr import UsdGeom

        prim = self._stage.GetPrimAtPath(path)
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))[:3, :3]
        scales = np.linalg.norm(matrix, axis=1)[order]
        unit = matrix[order] / scales[:, None]
        alike = {"sphere": scales, "capsule": scales, "cylinder": scales[:2]}.get(kind, scales[:1])
        skew = np.abs(unit @ unit.T - np.eye(3)).max()
        return bool(max(np.ptp(alike) / scales.max(), skew) < _EVEN)

    def _touch(self, shape: Any) -> Touch:
        body = self._bodies.get(shape.rigidBody)
        both = [shape] if body is None else [shape, body]
        material = next((m for p in shape.materials if (m := self._materials.get(p))), None)
        return Touch(
            paths=tuple(each.primPath for each in both),
            filtered=tuple(path for each in both for path in each.filteredCollisions),
            groups=tuple(shape.collisionGroups),
            friction=_shortest_decimal(material.dynamicFriction) if material is not None else None,
            restitution=_shortest_decimal(material.restitution) if material is not None else None,
        )

    def pair(self, shape: Solid, floor: Solid | None) -> Pair:
        """Return how a shape meets the ground; see `parts.Solids`."""
        sides: list[Touch] = [each.own for each in (shape, floor) if each is not None]
        apart = self._apart(*sides) if floor is not None else ""
        friction, restitution = (
            _mean([getattr(side, key) for side in sides]) for key in ("friction", "restitution")
        )
        return Pair(friction, restitution, apart)

    def _apart(self, one: Touch, other: Touch) -> str:
        for first, second in ((one, other), (other, one)):
            if any(path.HasPrefix(prefix) for prefix in first.filtered for path in second.paths):
                return "filteredPairs keeps it from the ground"
            if any(self._filters(a, b) for a in first.groups for b in second.groups):
                return "its collision group does not meet the ground's"
        return ""

    def _filters(self, group: Any, other: Any) -> bool:
        """Whether a collision group does not collide with another."""
        filtered = set(self._groups[group].filteredGroups)
        inverted = any(
            _is_inverted(self._stage.GetPrimAtPath(p)) for p in self._merged_groups(group)
        )
        return bool(filtered & set(self._merged_groups(other))) != inverted

    def _merged_groups(self, group: Any) -> list[Any]:
        """Return the paths of all groups merged with a group, including its own."""
        return [group, *self._groups[group].mergedGroups]


def _is_inverted(group: Any) -> bool:
    """Whether a group collides only with those it names; the library reports this of all groups."""
    return bool(group.GetAttribute("physics:invertFilteredGroups").Get())


def _size(shape: Any, kind: str) -> Array:
    """Return half-sizes in units of the stage, as `balls.BALLS` takes them."""
    if kind == "box":
        return np.array(shape.halfExtents, dtype=float)
    if kind in ("sphere", "capsule", "cylinder"):
        return np.array([shape.radius, getattr(shape, "halfHeight", 0.0), 0.0])
    return np.zeros(3)


def _shortest_decimal(value: float) -> float:
    """Return a single-precision number as the file states it: 0.7 and not 0.69999999."""
    return float(str(np.float32(value)))


def _mean(values: list[float | None]) -> float | None:
    stated = [value for value in values if value is not None]
    return sum(stated) / len(stated) if stated else None
