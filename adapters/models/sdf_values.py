"""Numbers, poses and masses in elements of SDF."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError


def numbers(element: Element, path: str, unstated: tuple[float, ...]) -> Array:
    """Read the numbers of an element below another.

    Args:
        element: The other.
        path: To what is read, as in `surface/friction/ode/mu`.
        unstated: What counts where it is not there; as many are read.

    Raises:
        InputError: There are fewer or more, or one is not a finite number.
    """
    words = element.findtext(path)
    if words is None:
        return np.array(unstated)
    try:
        found = [float(word) for word in words.split()]
    except ValueError:
        found = []
    if len(found) != len(unstated) or not all(map(math.isfinite, found)):
        tag = path.rpartition("/")[2]
        count = {1: "a number", 3: "three numbers", 6: "six numbers"}[len(unstated)]
        msg = f"<{tag}> of <{element.tag}> {element.get('name', '')!r} is {words!r}, "
        raise InputError(f"{msg}allowed is {count}")
    return np.array(found)


def number(element: Element, path: str, unstated: float) -> float:
    """Read one number, as in `numbers`."""
    return float(numbers(element, path, (unstated,))[0])


def pose(element: Element, path: str = "pose") -> tuple[Array, Array]:
    """Give place [m], shape (3,), and axes as columns, shape (3, 3), of an element's pose."""
    found = numbers(element, path, (0.0,) * 6)
    turns = (rotation.from_vector(v) for v in np.diag(found[3:]))
    about_x, about_y, about_z = map(rotation.matrix, turns)
    return found[:3], np.asarray(about_z @ about_y @ about_x)


def masses_of(model: Element) -> dict[str, tuple[float, Array]]:
    """Read the masses of a model's links, and refuse names that stand twice.

    Returns:
        Mass [kg], and inertia about its centre along the link's axes [kg·m²], shape (3, 3), by
        link. Where a file states none they are DART's: 1 kg, and moments of 1 m² times the mass.

    Raises:
        InputError: A mass or moment is none that it can be, or two links have one name.
    """
    links = model.findall("link")
    found = {link.get("name", ""): _mass(link) for link in links}
    for name, (mass, _) in found.items():
        if mass <= 0 and model.findtext("static") not in ("1", "true"):
            msg = f"<mass> of <link> {name!r} is {mass:g}, allowed is above 0; what does not "
            raise InputError(f"{msg}move needs one, too, and a fixed joint to the world")
    if len(found) < len(links):
        names = [link.get("name", "") for link in links]
        twice = next(name for name in names if names.count(name) > 1)
        msg = f"<model> {model.get('name', '')!r} has two links called {twice!r}, allowed is one"
        raise InputError(msg)
    return found


def _mass(link: Element) -> tuple[float, Array]:
    mass = number(link, "inertial/mass", 1.0)
    xx, yy, zz, xy, xz, yz = (
        number(link, f"inertial/inertia/i{key}", mass if key[0] == key[1] else 0.0)
        for key in ("xx", "yy", "zz", "xy", "xz", "yz")
    )
    axes = pose(link, "inertial/pose")[1]
    return mass, axes @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axes.T
