"""Collision shapes of a compiled model, and how MuJoCo pairs them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mbds_xsim.scene.imported import Fate

from .fates import PAIRING
from .parts import Pair, Solid, Solids
from .resolved import Resolved

_KINDS = ("plane", "height field", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh",
          "signed distance field")  # fmt: skip
"""Kinds of geoms, in the order of MuJoCo's `mjtGeom`."""


class Geoms:
    """Collision shapes at the reference pose, and the format's word for them."""

    def __init__(self, resolved: Resolved, element: str) -> None:
        self._model, self._data, self._element = resolved.model, resolved.data, element
        self._active = not resolved.off["CONTACT"]

    def solids(self) -> Solids:
        """Return all shapes but those that are only drawn."""
        return Solids(self._element, tuple(map(self._solid, touching(self._model))), self._pair)

    def _solid(self, g: int) -> Solid:
        model, data = self._model, self._data
        return Solid(
            name=self._name(g),
            part=int(model.geom_bodyid[g]) - 1,
            kind=_KINDS[model.geom_type[g]],
            size=model.geom_size[g].copy(),
            place=data.geom_xpos[g].copy(),
            axes=data.geom_xmat[g].reshape(3, 3).copy(),
            own=g,
        )

    def fates(self) -> Iterator[Fate]:
        """Report how shapes are paired with the ground."""
        reason = "as MuJoCo pairs each shape with the ground"
        if self._element == "geom":
            yield Fate("geom", PAIRING["geom"], "kept", reason, True)
        if self._model.nexclude:
            yield Fate("exclude", (), "kept", reason, True)

    def _name(self, g: int) -> str:
        geom = self._model.geom(g)
        return geom.name or f"of {self._model.body(geom.bodyid[0]).name or geom.bodyid[0]}"

    def _pair(self, shape: Solid, floor: Solid | None) -> Pair:
        """Return a shape's contact with the ground, by MuJoCo's rules.

        Of the geoms of the highest priority, the largest values count.
        """
        model, g, plane = self._model, shape.own, floor.own if floor is not None else None
        geoms = [g] if plane is None else [g, plane]
        highest = max(model.geom_priority[k] for k in geoms)
        deciding = [k for k in geoms if model.geom_priority[k] == highest]
        dimension = int(max(model.geom_condim[k] for k in deciding))
        friction = None
        if self._element == "geom":
            slippery = dimension == 1
            friction = 0.0 if slippery else float(max(model.geom_friction[k, 0] for k in deciding))
        return Pair(friction, None, self._apart(g, plane), dimension > 3)

    def _apart(self, g: int, plane: int | None) -> str:
        """Return why a shape passes through the ground, or "" if it does not."""
        model = self._model
        if not self._active:
            return "contact is switched off in the file"
        if plane is not None:
            first, second = sorted(int(model.geom_bodyid[k]) for k in (plane, g))
            if (first << 16) + second in model.exclude_signature:
                return "the file excludes contact of its body and the ground"
        masks = model.geom_contype, model.geom_conaffinity
        own = [mask[g] for mask in masks]
        other = [1, 1] if plane is None else [mask[plane] for mask in masks]  # a plane's default
        meets = own[0] & other[1] or other[0] & own[1]
        return "" if meets else "by contype and conaffinity it passes through the ground"


def touching(model: Any) -> list[int]:
    """Return the geoms that are not only drawn."""
    return [g for g in range(model.ngeom) if model.geom_contype[g] | model.geom_conaffinity[g]]
