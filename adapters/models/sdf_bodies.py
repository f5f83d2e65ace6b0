"""Bodies of SDF: numbers, poses, masses and collision shapes, and how two of these touch.

The format describes each surface but not how two of them combine. The smaller friction and
restitution count here, as in Gazebo, for which the format was made.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import and_
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError

from .parts import Mass, Pair, Part, Solid

_TAGS = ("collision", "geometry", "mu", "restitution_coefficient", "torsional")
REPORTED = (("collision", "name"), *((tag, "") for tag in _TAGS))
"""Elements and attributes that `contacts` reports shape by shape."""
_DIMENSIONS = {
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "cylinder": ("radius", "length"),
    "box": ("size",),
}
_ALL = 0xFFFF
"""Collision mask of shapes that state none."""
_NEVER = 1e5  # [m/s]: default of the speed from which a surface rebounds
_SURFACE = (
    ("friction/ode/mu", 1.0),
    ("bounce/restitution_coefficient", 0.0),
    ("bounce/threshold", _NEVER),
)
"""Paths to the numbers of a surface, each with its default."""


def numbers(
    element: Element, path: str, unstated: tuple[float, ...], *, endless: bool = False
) -> Array:
    """Read the numbers in an element below another.

    Args:
        element: The element to start from.
        path: Path to the element that is read, such as `surface/friction/ode/mu`.
        unstated: Values if that element is absent; if present, it must have as many.
        endless: Whether numbers may be infinite.

    Raises:
        InputError: There are fewer or more numbers, or one is not finite.
    """
    text = element.findtext(path)
    if text is None:
        return np.array(unstated)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    sound = [math.isfinite(value) or (endless and math.isinf(value)) for value in values]
    if len(values) != len(unstated) or not all(sound):
        tag = path.rpartition("/")[2]
        count = {1: "a number", 3: "three numbers", 6: "six numbers"}[len(unstated)]
        msg = f"<{tag}> of <{element.tag}> {element.get('name', '')!r} is {text!r}, "
        raise InputError(f"{msg}allowed is {count}")
    return np.array(values)


def number(element: Element, path: str, unstated: float) -> float:
    """Read one number, as in `numbers`."""
    return float(numbers(element, path, (unstated,))[0])


def pose(element: Element, path: str = "pose") -> tuple[Array, Array]:
    """Return position [m], shape (3,), and axes as columns, shape (3, 3), of an element's pose."""
    values = numbers(element, path, (0.0,) * 6)
    turns = (rotation.from_vector(v) for v in np.diag(values[3:]))
    about_x, about_y, about_z = map(rotation.matrix, turns)
    return values[:3], np.asarray(about_z @ about_y @ about_x)


def masses_of(model: Element) -> dict[str, Mass]:
    """Read the masses of a model's links, in the links' frames.

    Returns:
        Masses keyed by link. Defaults are the specification's: 1 kg, and moments of 1 kg·m².

    Raises:
        InputError: A number is malformed, a moving mass is not above 0, or a mass would follow from
            shapes.
    """
    links, static = model.findall("link"), model.findtext("static") in ("1", "true")
    for link in links if not static else ():
        inertial = link.find("inertial")
        if inertial is not None and inertial.get("auto") in ("1", "true"):
            raise InputError(
                f'<inertial> of <link> {link.get("name", "")!r} has auto="true", but masses of '
                "shapes are not computed; state its <pose>, <mass> and <inertia>"
            )
    names = [link.get("name", "") for link in links]
    masses = dict(zip(names, map(_mass, links), strict=True))
    for name, each in masses.items():
        if each.mass <= 0 and not static:
            msg = f"<mass> of <link> {name!r} is {each.mass:g}, allowed is above 0; a link that "
            raise InputError(f"{msg}does not move needs one, too, and a fixed joint to the world")
    return masses


def _mass(link: Element) -> Mass:
    xx, yy, zz, xy, xz, yz = (
        number(link, f"inertial/inertia/i{key}", 1.0 if key[0] == key[1] else 0.0)
        for key in ("xx", "yy", "zz", "xy", "xz", "yz")
    )
    place, axes = pose(link, "inertial/pose")
    inertia = axes @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axes.T
    return Mass(number(link, "inertial/mass", 1.0), place, inertia)


def shapes_of(model: Element, parts: Sequence[Part], first: int) -> Iterator[Solid]:
    """Yield the collision shapes of a model.

    Args:
        model: The `<model>` element.
        parts: Parts of this model, in the order in which they stand among all parts.
        first: Index of the first of them among all parts.

    Raises:
        InputError: A pose or size is malformed or out of range.
    """
    index = {part.name: k for k, part in enumerate(parts)}
    for link in model.findall("link"):
        k = index[link.get("name", "")]
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
    """Return half-sizes as `contacts.BALLS` takes them."""
    size = np.zeros(3)
    for k, tag in enumerate(_DIMENSIONS.get(kind, ())):
        path = f"geometry/{kind}/{tag}"
        dimensions = numbers(shape, path, (0.0,) * (3 if tag == "size" else 1))
        if not (dimensions > 0).all():
            text = shape.findtext(path, "not there")
            msg = f"<{tag}> of <collision> {shape.get('name', '')!r} is {text}, allowed is above 0"
            raise InputError(msg)
        size[k : k + len(dimensions)] = dimensions / (1.0 if tag == "radius" else 2.0)
    return size


def _normal(shape: Element) -> Array:
    """Return axes in columns, the third of which is a plane's normal."""
    normal = numbers(shape, "geometry/plane/normal", (0.0, 0.0, 1.0))
    if not normal.any():
        msg = f"<normal> of <collision> {shape.get('name', '')!r} is 0 0 0, allowed is any other"
        raise InputError(msg)
    normal /= np.linalg.norm(normal)
    return np.column_stack([*rotation.normal_to(normal), normal])


def pair(shape: Solid, floor: Solid | None) -> Pair:
    """Return how a shape meets the ground; see `parts.Solids`."""
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
    text = shape.findtext("surface/contact/collide_bitmask", str(_ALL))
    try:
        return int(text, 0)
    except ValueError as error:
        msg = f"<collide_bitmask> of {shape.get('name', '')!r} is {text!r}, allowed is an integer"
        raise InputError(msg) from error
