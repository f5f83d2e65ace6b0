"""The plane in a file that is the ground, and a shift of the model that puts it at z = 0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mbds_xsim.base import bounds
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import Fate

from .parts import Freedom, Mass, Part, Parts, Solid, Solids

_LEVEL = 1.0 - 1e-9  # least vertical part of the unit normal of a horizontal plane


def floor_of(model: Parts) -> Solid | None:
    """Return the first horizontal plane that is fixed in the world; None if there is none."""
    shapes = model.solids.shapes if model.solids is not None else ()
    planes = (s for s in shapes if s.kind == "plane" and s.axes[2, 2] > _LEVEL)
    return next((plane for plane in planes if _is_fixed(model.parts, plane.part)), None)


def _is_fixed(parts: tuple[Part, ...], k: int) -> bool:
    while k >= 0 and not parts[k].freedoms:
        k = parts[k].parent
    return k < 0


def on_the_floor(model: Parts, floor: Solid | None) -> Parts:
    """Return the model shifted so that the ground is at z = 0; the plane itself keeps its place."""
    if model.solids is None or floor is None or not floor.place[2]:
        return model
    bounds.finite(f"place of {floor.name!r}", tuple(floor.place.tolist()))
    shift = np.array([0.0, 0.0, -floor.place[2]])
    return replace(
        model,
        parts=tuple(_shift_part(part, shift) for part in model.parts),
        closings=tuple(replace(each, anchor=each.anchor + shift) for each in model.closings),
        lines=tuple(
            replace(each, points=(each.points[0] + shift, each.points[1] + shift))
            for each in model.lines
        ),
        solids=replace(
            model.solids,
            shapes=tuple(
                shape if shape is floor else replace(shape, place=shape.place + shift)
                for shape in model.solids.shapes
            ),
        ),
    )


def _shift_part(part: Part, by: Array) -> Part:
    mass: Mass = replace(part.mass, com=part.mass.com + by)
    freedoms: tuple[Freedom, ...] = tuple(replace(f, anchor=f.anchor + by) for f in part.freedoms)
    return replace(part, position=part.position + by, mass=mass, freedoms=freedoms)


def floor_fates(solids: Solids, floor: Solid | None) -> Iterator[Fate]:
    """Report which plane is the ground, and that bodies collide with nothing else."""
    if floor is not None:
        note = f"the ground, z = 0, which in the file is at z = {floor.place[2]:g} m"
        yield Fate(solids.element, ("plane",), "kept", note, True, (floor.name,))
    else:
        note = "no horizontal plane is fixed in the world: the ground is the plane z = 0"
        yield Fate(solids.element, ("plane",), "approximated", note, True)
    names = tuple(shape.name for shape in solids.shapes if shape is not floor)
    if len(names) > 1:
        reason = "collisions between bodies are not imported; a scene file can add [collisions]"
        yield Fate(solids.element, ("contact",), "dropped", reason, True, names, len(names))
