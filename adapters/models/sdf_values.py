"""Numbers, poses and masses in elements of SDF."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError


def numbers(element: Element, path: str, unstated: tuple[float, ...]) -> Array:
    """Read the numbers in an element below another.

    Args:
        element: The element to start from.
        path: Path to the element that is read, such as `surface/friction/ode/mu`.
        unstated: Values if that element is absent; if present, it must have as many.

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
    if len(values) != len(unstated) or not all(map(math.isfinite, values)):
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


def masses_of(model: Element) -> dict[str, tuple[float, Array]]:
    """Read the masses of a model's links, and refuse duplicate names.

    Returns:
        Mass [kg], and inertia about its centre along the link's axes [kg·m²], shape (3, 3), keyed
        by link. Defaults are DART's: 1 kg, and moments of 1 m² times the mass.

    Raises:
        InputError: A number is malformed, a moving mass is not above 0, or two links share a name.
    """
    links = model.findall("link")
    masses = {link.get("name", ""): _mass(link) for link in links}
    for name, (mass, _) in masses.items():
        if mass <= 0 and model.findtext("static") not in ("1", "true"):
            msg = f"<mass> of <link> {name!r} is {mass:g}, allowed is above 0; a link that does "
            raise InputError(f"{msg}not move needs one, too, and a fixed joint to the world")
    if len(masses) < len(links):
        names = [link.get("name", "") for link in links]
        repeated = next(name for name in names if names.count(name) > 1)
        msg = f"<model> {model.get('name', '')!r} has two links called {repeated!r}, allowed is one"
        raise InputError(msg)
    return masses


def _mass(link: Element) -> tuple[float, Array]:
    mass = number(link, "inertial/mass", 1.0)
    xx, yy, zz, xy, xz, yz = (
        number(link, f"inertial/inertia/i{key}", mass if key[0] == key[1] else 0.0)
        for key in ("xx", "yy", "zz", "xy", "xz", "yz")
    )
    axes = pose(link, "inertial/pose")[1]
    return mass, axes @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axes.T
