"""Numbers, poses and masses in elements of SDF."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError

from .parts import Mass


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
    """Read the masses of a model's links, in the links' frames, and refuse duplicate names.

    Returns:
        Masses keyed by link. Defaults are the specification's: 1 kg, and moments of 1 kg·m².

    Raises:
        InputError: A number is malformed, a moving mass is not above 0, two links share a name, or
            a mass would follow from shapes.
    """
    links = model.findall("link")
    for link in links if not is_static(model) else ():
        _check_stated(link)
    masses = {link.get("name", ""): _mass(link) for link in links}
    for name, each in masses.items():
        if each.mass <= 0 and not is_static(model):
            msg = f"<mass> of <link> {name!r} is {each.mass:g}, allowed is above 0; a link that "
            raise InputError(f"{msg}does not move needs one, too, and a fixed joint to the world")
    if len(masses) < len(links):
        names = [link.get("name", "") for link in links]
        repeated = next(name for name in names if names.count(name) > 1)
        msg = f"<model> {model.get('name', '')!r} has two links called {repeated!r}, allowed is one"
        raise InputError(msg)
    return masses


def is_static(model: Element) -> bool:
    """Whether a model does not move."""
    return model.findtext("static") in ("1", "true")


def _check_stated(link: Element) -> None:
    """Raise InputError if a mass would follow from shapes."""
    inertial = link.find("inertial")
    if inertial is not None and inertial.get("auto") in ("1", "true"):
        where = f"<inertial> of <link> {link.get('name', '')!r}"
        raise InputError(
            f'{where} has auto="true", but masses of shapes are not computed; state its <pose>, '
            "<mass> and <inertia>"
        )


def _mass(link: Element) -> Mass:
    xx, yy, zz, xy, xz, yz = (
        number(link, f"inertial/inertia/i{key}", 1.0 if key[0] == key[1] else 0.0)
        for key in ("xx", "yy", "zz", "xy", "xz", "yz")
    )
    place, axes = pose(link, "inertial/pose")
    inertia = axes @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axes.T
    return Mass(number(link, "inertial/mass", 1.0), place, inertia)
