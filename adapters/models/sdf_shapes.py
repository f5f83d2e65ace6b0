"""Collision shapes of SDF, and how two of them touch.

The format says what each surface is like and leaves open what counts where two differ: the smaller
friction and restitution do, as in Gazebo, for which it was made.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import Fate

from .parts import Pair, Part, Solid
from .sdf_values import number, numbers, pose

TOLD = (
    ("collision", ""),
    ("collision", "name"),
    ("geometry", ""),
    ("mu", ""),
    ("restitution_coefficient", ""),
    ("torsional", ""),
)
"""Elements and attributes of which `contacts` says more."""
_DIMENSIONS = {
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "cylinder": ("radius", "length"),
    "box": ("size",),
}
_ALL = 0xFFFF
"""The mask of what states none."""
_NEVER = 1e5  # [m/s], from which on a surface rebounds that states no speed
_NO_REBOUND = f"of no effect below its threshold, which is {_NEVER:g} m/s"


@dataclass(frozen=True, eq=False)
class Surface:
    """How a shape touches others."""

    mask: int
    friction: float
    restitution: float
    threshold: float
    """Least speed that it gives some of back [m/s]."""
    rolls: bool
    """Whether it has torsional friction."""
    senses: bool
    """Whether it is met without being stopped."""


def shapes_of(model: Element, parts: Sequence[Part], first: int) -> Iterator[Solid]:
    """Give the shapes of a model.

    Args:
        model: The element.
        parts: Of this model, in the order of all.
        first: Place of its first one among all.

    Raises:
        InputError: A pose, size or coefficient is no number that it can be.
    """
    place = {part.name: k for k, part in enumerate(parts)}
    for link in model.findall("link"):
        k = place[link.get("name", "")]
        turn = rotation.matrix(parts[k].orientation)
        for shape in link.findall("collision"):
            middle, axes = pose(shape)
            kind = next((child.tag for child in shape.findall("geometry/*")), "empty")
            yield Solid(
                name=f"{shape.get('name', '')} of {parts[k].name}",
                part=first + k,
                kind=kind,
                size=_size(shape, kind),
                place=parts[k].position + turn @ middle,
                axes=turn @ axes @ (_normal(shape) if kind == "plane" else np.eye(3)),
                own=_surface(shape),
            )


def _size(shape: Element, kind: str) -> Array:
    """Give half-sizes, as `balls.BALLS` has them."""
    size = np.zeros(3)
    for k, tag in enumerate(_DIMENSIONS.get(kind, ())):
        path = f"geometry/{kind}/{tag}"
        found = numbers(shape, path, (0.0,) * (3 if tag == "size" else 1))
        if not (found > 0).all():
            told = shape.findtext(path, "not there")
            msg = f"<{tag}> of <collision> {shape.get('name', '')!r} is {told}, allowed is above 0"
            raise InputError(msg)
        size[k : k + len(found)] = found / (1.0 if tag == "radius" else 2.0)
    return size


def _normal(shape: Element) -> Array:
    """Give axes of which the third is a plane's normal."""
    normal = numbers(shape, "geometry/plane/normal", (0.0, 0.0, 1.0))
    normal /= np.linalg.norm(normal) or 1.0
    return np.column_stack([*rotation.normal_to(normal), normal])


def _surface(shape: Element) -> Surface:
    mask = shape.findtext("surface/contact/collide_bitmask", str(_ALL))
    try:
        bits = int(mask, 0)
    except ValueError as error:
        msg = f"<collide_bitmask> of {shape.get('name', '')!r} is {mask!r}, allowed is an integer"
        raise InputError(msg) from error
    senses = shape.findtext("surface/contact/collide_without_contact", "").strip()
    return Surface(
        mask=bits,
        friction=number(shape, "surface/friction/ode/mu", 1.0),
        restitution=number(shape, "surface/bounce/restitution_coefficient", 0.0),
        threshold=number(shape, "surface/bounce/threshold", _NEVER),
        rolls=shape.find("surface/friction/torsional") is not None,
        senses=senses in ("1", "true"),
    )


def pair(shape: Solid, floor: Solid | None) -> Pair:
    """Say how a shape meets the ground; see `parts.Solids`."""
    sides = _sides(shape, floor)
    apart = "by collide_bitmask it passes through the ground"
    meets = sides[0].mask & (sides[-1].mask if floor is not None else _ALL)
    if meets and any(side.senses for side in sides):
        apart, meets = "it collides without contact: it only senses what it meets", 0
    return Pair(
        friction=min(side.friction for side in sides),
        restitution=min(side.restitution for side in sides) if _rebounds(sides) else 0.0,
        apart="" if meets else apart,
        rolls=any(side.rolls for side in sides),
    )


def _sides(shape: Solid, floor: Solid | None) -> list[Surface]:
    return [each.own for each in (shape, floor) if each is not None]


def _rebounds(sides: list[Surface]) -> bool:
    return min(side.threshold for side in sides) < _NEVER


def shape_fates(shapes: Iterable[Solid], floor: Solid | None) -> Iterator[Fate]:
    """Name the shapes that state a restitution, and no speed from which on it counts."""
    stated = [shape for shape in shapes if shape is not floor and shape.own.restitution]
    if idle := tuple(s.name for s in stated if not _rebounds(_sides(s, floor))):
        yield Fate("restitution_coefficient", (), "kept", _NO_REBOUND, True, idle, len(idle))
