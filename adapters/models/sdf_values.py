"""Numbers and poses in elements of SDF."""

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
