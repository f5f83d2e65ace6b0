"""Collision shapes of USD Physics, and how two of them touch.

Its schema leaves open what counts where two materials differ: their mean does, as in PhysX, for
which it was made. Groups and pairs that do not collide are as the schema has them:
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
"""Axes of the prim in the order in which those of a shape along its z are."""
_EVEN = 1e-6  # difference of scales that rounding to single precision explains


@dataclass(frozen=True, eq=False)
class Touch:
    """How a shape touches others."""

    paths: tuple[Any, ...]
    """Its own and that of its body."""
    filtered: tuple[Any, ...]
    """What neither collides with, and all below it."""
    groups: tuple[Any, ...]
    friction: float | None
    restitution: float | None


class Shapes:
    """The collision shapes of a stage.

    Args:
        stage: The stage.
        listed: Gives all that the library finds of a kind.
        frame: Gives place and axes of a prim in W.
        name: Names a prim.
        metre: Length of a unit [m].
    """

    def __init__(
        self,
        stage: Any,
        listed: Callable[[str], list[Any]],
        frame: Callable[[Any], tuple[Array, Array]],
        name: Callable[[Any], str],
        metre: float,
    ) -> None:
        self._stage, self._listed = stage, listed
        self._frame, self._name, self._metre = frame, name, metre
        self._materials = {each.primPath: each for each in listed("RigidBodyMaterial")}
        self._bodies = {each.primPath: each for each in listed("RigidBody")}
        groups = listed("CollisionGroup")
        self._groups = {path: g for g in groups for path in (g.primPath, *g.mergedGroups)}

    def solids(self, part: Mapping[Any, int]) -> Iterator[Solid]:
        """Give the shapes that collide.

        Args:
            part: Of bodies that move, by path.
        """
        from pxr import UsdPhysics

        for listing in filter(re.compile("Shape$").search, dir(UsdPhysics.ObjectType)):
            kind = listing.removesuffix("Shape").lower().replace("cube", "box")
            for shape in self._listed(listing):
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
        """Whether a shape that is scaled is still of its kind."""
        from pxr import UsdGeom

        prim = self._stage.GetPrimAtPath(path)
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))[:3, :3]
        scales = np.linalg.norm(matrix, axis=1)[order]
        unit = matrix[order] / scales[:, None]
        alike = {"sphere": scales, "capsule": scales, "cylinder": scales[:2]}.get(kind, scales[:1])
        skewed = np.abs(unit @ unit.T - np.eye(3)).max()
        return bool(max(np.ptp(alike) / scales.max(), skewed) < _EVEN)

    def _touch(self, shape: Any) -> Touch:
        body = self._bodies.get(shape.rigidBody)
        both = [shape] if body is None else [shape, body]
        material = next((m for p in shape.materials if (m := self._materials.get(p))), None)
        return Touch(
            paths=tuple(each.primPath for each in both),
            filtered=tuple(path for each in both for path in each.filteredCollisions),
            groups=tuple(shape.collisionGroups),
            friction=_written(material.dynamicFriction) if material is not None else None,
            restitution=_written(material.restitution) if material is not None else None,
        )

    def pair(self, shape: Solid, floor: Solid | None) -> Pair:
        """Say how a shape meets the ground; see `parts.Solids`."""
        sides: list[Touch] = [each.own for each in (shape, floor) if each is not None]
        apart = self._apart(*sides) if floor is not None else ""
        friction, restitution = (
            _mean([getattr(side, key) for side in sides]) for key in ("friction", "restitution")
        )
        return Pair(friction, restitution, apart)

    def _apart(self, one: Touch, other: Touch) -> str:
        for first, second in ((one, other), (other, one)):
            if any(path.HasPrefix(no) for no in first.filtered for path in second.paths):
                return "filteredPairs keeps it from the ground"
            if any(self._filters(a, b) for a in first.groups for b in second.groups):
                return "its collision group does not meet the ground's"
        return ""

    def _filters(self, group: Any, other: Any) -> bool:
        """Whether a collision group does not collide with another."""
        named = set(self._groups[group].filteredGroups)
        inverted = any(_inverted(self._stage.GetPrimAtPath(p)) for p in self._merged(group))
        return bool(named & set(self._merged(other))) != inverted

    def _merged(self, group: Any) -> list[Any]:
        """Give the paths of the groups that a group is one with, its own among them."""
        return [group, *self._groups[group].mergedGroups]


def _inverted(group: Any) -> bool:
    """Whether a group collides with those alone that it names; the library tells it of all."""
    return bool(group.GetAttribute("physics:invertFilteredGroups").Get())


def _size(shape: Any, kind: str) -> Array:
    """Give half-sizes in units of the stage, as `balls.BALLS` has them."""
    if kind == "box":
        return np.array(shape.halfExtents, dtype=float)
    if kind in ("sphere", "capsule", "cylinder"):
        return np.array([shape.radius, getattr(shape, "halfHeight", 0.0), 0.0])
    return np.zeros(3)


def _written(value: float) -> float:
    """Give a number of single precision as a file has it: 0.7 is not 0.69999998."""
    return float(str(np.float32(value)))


def _mean(values: list[float | None]) -> float | None:
    stated = [value for value in values if value is not None]
    return sum(stated) / len(stated) if stated else None
