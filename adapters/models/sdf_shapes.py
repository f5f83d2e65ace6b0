"""Collision shapes of SDF, and how two of them touch.

The format says what each surface is like and leaves open what counts where two differ: the smaller
friction and restitution do, as in Gazebo, for which it was made.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from operator import and_
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError

from .parts import Pair, Part, Solid
from .sdf_values import number, numbers, pose

_TAGS = ("collision", "geometry", "mu", "restitution_coefficient", "torsional")
TOLD = (("collision", "name"), *((tag, "") for tag in _TAGS))
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
_SURFACE = (
    ("friction/ode/mu", 1.0),
    ("bounce/restitution_coefficient", 0.0),
    ("bounce/threshold", _NEVER),
)
"""Numbers of a surface, and what counts where one is not stated."""


def shapes_of(model: Element, parts: Sequence[Part], first: int) -> Iterator[Solid]:
    """Give the shapes of a model.

    Args:
        model: The element.
        parts: Of this model, in the order of all.
        first: Place of its first one among all.

    Raises:
        InputError: A pose or size is no number that it can be.
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
                own=shape,
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
    if not normal.any():
        msg = f"<normal> of <collision> {shape.get('name', '')!r} is 0 0 0, allowed is any other"
        raise InputError(msg)
    normal /= np.linalg.norm(normal)
    return np.column_stack([*rotation.normal_to(normal), normal])


def pair(shape: Solid, floor: Solid | None) -> Pair:
    """Say how a shape meets the ground; see `parts.Solids`."""
    sides: list[Element] = [each.own for each in (shape, floor) if each is not None]
    friction, restitution, threshold = (
        min(number(side, f"surface/{path}", unstated) for side in sides)
        for path, unstated in _SURFACE
    )
    idle = restitution > 0.0 and threshold >= _NEVER
    return Pair(
        friction=friction,
        restitution=0.0 if idle else restitution,
        apart=_apart(sides),
        rolls=any(side.find("surface/friction/torsional") is not None for side in sides),
        note=f"no restitution below the threshold, which is {threshold:g} m/s" if idle else "",
    )


def _apart(sides: list[Element]) -> str:
    if not reduce(and_, map(_mask, sides), _ALL):
        return "by collide_bitmask it passes through the ground"
    tag = "surface/contact/collide_without_contact"
    senses = any(side.findtext(tag, "").strip() in ("1", "true") for side in sides)
    return "it collides without contact: it only senses what it meets" if senses else ""


def _mask(shape: Element) -> int:
    words = shape.findtext("surface/contact/collide_bitmask", str(_ALL))
    try:
        return int(words, 0)
    except ValueError as error:
        msg = f"<collide_bitmask> of {shape.get('name', '')!r} is {words!r}, allowed is an integer"
        raise InputError(msg) from error
