"""Collision shapes of a compiled model, and the plane that they can meet."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mbds_xsim.scene.imported import Fate

from .parts import Solid

_KINDS = ("plane", "height field", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh",
          "signed distance field")  # fmt: skip
"""As MuJoCo counts them."""
PAIRING = {
    "geom": ("contype", "conaffinity", "condim", "priority", "friction"),
    "exclude": ("name", "body1", "body2"),
}
"""Elements and attributes of MJCF that say how shapes meet."""
_LEVEL = 1.0 - 1e-9  # vertical part of the normal of a horizontal plane


class Geoms:
    """Collision shapes at the reference pose, with all places moved so that the ground is z = 0.

    Args:
        model: The compiled model.
        data: Its places, which are moved.
        element: What the format calls a shape.
        active: Whether there is contact at all.
    """

    def __init__(self, model: Any, data: Any, element: str, *, active: bool) -> None:
        self._model, self._data, self._element, self._active = model, data, element, active
        floors = (g for g in range(model.ngeom) if self._is_floor(g))
        self._plane = next(floors, -1)
        """The first horizontal one that is fixed; −1: none."""
        self._height = float(data.geom_xpos[self._plane, 2]) if self._plane >= 0 else 0.0
        """Of the ground in the file [m]."""
        for places in ("xpos", "xanchor", "site_xpos", "geom_xpos"):
            getattr(data, places)[:, 2] -= self._height

    def shapes(self) -> Iterator[Solid]:
        """Give all but the ground, and what is drawn only."""
        model, data = self._model, self._data
        for g in self._solid():
            yield Solid(
                element=self._element,
                name=self._name(g),
                part=int(model.geom_bodyid[g]) - 1,
                kind=_KINDS[model.geom_type[g]],
                size=model.geom_size[g].copy(),
                place=data.geom_xpos[g].copy(),
                axes=data.geom_xmat[g].reshape(3, 3).copy(),
                friction=self._friction(g) if self._element == "geom" else None,
                apart=self._apart(g),
            )

    def fates(self) -> Iterator[Fate]:
        """Say which plane is the ground, and what of contact is not on it."""
        if self._plane >= 0:
            how = f"the ground, z = 0, which in the file is at z = {self._height:g} m"
            yield Fate("geom", ("plane",), "kept", how, True, (self._name(self._plane),))
        else:
            how = "no horizontal plane is fixed in the world: the ground is the plane z = 0"
            yield Fate(self._element, ("plane",), "approximated", how, True)
        names = tuple(map(self._name, self._solid()))
        reason = "bodies do not collide with each other in the scene description"
        if len(names) > 1:
            yield Fate(self._element, ("contact",), "dropped", reason, True, names, len(names))
        how = "as MuJoCo pairs each shape with the ground"
        if self._element == "geom":
            yield Fate("geom", PAIRING["geom"], "kept", how, True)
        if self._model.nexclude:
            yield Fate("exclude", (), "kept", how, True)
        rolling = [self._name(g) for g in self._solid() if self._dimension(g) > 3]
        if rolling:
            reason = "the ground has no torsional or rolling friction"
            yield Fate("geom", ("condim",), "dropped", reason, True, (*rolling,), len(rolling))

    def _solid(self) -> Iterator[int]:
        model = self._model
        for g in range(model.ngeom):
            if g != self._plane and model.geom_contype[g] | model.geom_conaffinity[g]:
                yield g

    def _name(self, g: int) -> str:
        geom = self._model.geom(g)
        return geom.name or f"of {self._model.body(geom.bodyid[0]).name or geom.bodyid[0]}"

    def _is_floor(self, g: int) -> bool:
        model = self._model
        level = self._data.geom_xmat[g, 8] > _LEVEL  # of its normal
        fixed = model.body_weldid[model.geom_bodyid[g]] == 0
        solid = model.geom_contype[g] | model.geom_conaffinity[g]
        return bool(_KINDS[model.geom_type[g]] == "plane" and level and fixed and solid)

    def _apart(self, g: int) -> str:
        """Say why a shape passes through the ground, "" where it does not."""
        model, plane = self._model, self._plane
        if not self._active:
            return "contact is switched off in the file"
        first, second = sorted(int(model.geom_bodyid[k]) for k in (plane, g))
        if plane >= 0 and (first << 16) + second in model.exclude_signature:
            return "the file excludes contact of its body and the ground"
        own, other = ((model.geom_contype[k], model.geom_conaffinity[k]) for k in (g, plane))
        other = other if plane >= 0 else (1, 1)  # as of planes that state none
        meets = own[0] & other[1] or other[0] & own[1]
        return "" if meets else "by contype and conaffinity it passes through the ground"

    def _dimension(self, g: int) -> int:
        return int(max(self._model.geom_condim[k] for k in self._deciding(g)))

    def _friction(self, g: int) -> float:
        """Give a shape's coefficient with the ground, by MuJoCo's rule."""
        if self._dimension(g) == 1:
            return 0.0
        return float(max(self._model.geom_friction[k, 0] for k in self._deciding(g)))

    def _deciding(self, g: int) -> list[int]:
        """Give the geoms whose numbers count: those of the higher priority; the larger ones do."""
        both = [g, self._plane] if self._plane >= 0 else [g]
        most = max(self._model.geom_priority[k] for k in both)
        return [k for k in both if self._model.geom_priority[k] == most]
