"""What older programs and lax readers let pass in MJCF and URDF, put as MuJoCo's compiler takes it.

Each mend changes the document and is told in the report. What it does not make plain stays as it
is, for the compiler to refuse.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from xml.etree.ElementTree import Element

from mbds_xsim.scene.imported import Fate, Outcome

from .source import DEFAULT

_SINGLE_NUMBERS = (
    *("value", "lower", "upper", "effort", "velocity", "damping", "friction"),
    *("multiplier", "offset", "ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
)
_NUMBERS = {"xyz": 3, "rpy": 3} | dict.fromkeys(_SINGLE_NUMBERS, 1)
"""Attributes of a URDF, and how many numbers each has."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_SINGLE = {"inertial", "mass", "inertia", "origin", "axis", "limit", "dynamics", "mimic"}
_UNRECOGNIZED = re.compile(r"unrecognized attribute: '([^']+)'\s+Element '([^']+)'")
_TURNED = {"quat", "axisangle", "xyaxes", "zaxis", "euler"}
_PLACED = ("joint", "geom", "site", "inertial")


def mended_urdf(root: Element) -> Iterator[Fate]:
    """Mend the document of a URDF, and say what was mended."""
    for holder in root:
        place = holder.get("name", "")
        for parent in (holder, *holder.findall("inertial")):
            for element in parent:
                if element.tag in _SINGLE:
                    yield from _with_plain_numbers(element, place)
            yield from _stated_once(parent, place)
        if holder.tag == "link" and place == "world":
            for element in holder.findall("inertial"):
                yield _removed(holder, element, "kept", "the world does not move")


def _with_plain_numbers(element: Element, place: str) -> Iterator[Fate]:
    for key, text in element.attrib.items():
        if (read := _read_as(text, _NUMBERS.get(key, 0))) != text:
            element.set(key, read)
            told = f"{place}: {text} read as {read}"
            yield _fate(element, "approximated", "not plain numbers", key, told)


def _stated_once(parent: Element, place: str) -> Iterator[Fate]:
    seen: dict[str, Element] = {}
    for element in list(parent):
        first = seen.setdefault(element.tag, element)
        if first is not element and element.tag in _SINGLE:
            parent.remove(element)
            outcome: Outcome = "kept" if first.attrib == element.attrib else "approximated"
            yield _fate(element, outcome, "stated again; the first counts", place=place)


def mended_mjcf(root: Element) -> Iterator[Fate]:
    """Mend the document of an MJCF file, but for attributes unknown to the compiler."""
    yield from _with_local_coordinates(root)
    settings = {key: value for c in root.iter("compiler") for key, value in c.attrib.items()}
    materials = {"", *(element.get("name", "") for element in root.iter("material"))}
    seen: set[tuple[str, str]] = set()
    for parent in root.iter():
        for child in list(parent):
            if child.get("material", "") not in materials:
                yield _without(child, "material", "there is no such material", moves=False)
            if parent.tag == "asset" and child.tag in ("material", "texture"):
                if (known := (child.tag, child.get("name", ""))) in seen and known[1]:
                    yield _removed(parent, child, "dropped", "drawn only; defined twice", False)
                seen.add(known)
            if child.tag == "joint" and child.get("type") == "fixed":
                yield _removed(parent, child, "kept", "no freedom at all")
            if child.tag == "inertial" and settings.get("inertiafromgeom") == "true":
                reason = "the compiler is told to take masses from geometry"
                yield _removed(parent, child, "dropped", reason)


def without_unknown(root: Element, complaint: str) -> Iterator[Fate]:
    """Take out of an MJCF document an attribute that the compiler complains of."""
    for attribute, tag in _UNRECOGNIZED.findall(complaint):
        for element in root.iter(tag):
            if attribute in element.attrib:
                yield _without(element, attribute, "unknown to MuJoCo's compiler")


def _with_local_coordinates(root: Element) -> Iterator[Fate]:
    """Put a model whose places all are in W into bodies whose frames are W's, as they may be."""
    bodies = [*root.iter("body")]
    inside = [child for body in bodies for child in body if child.tag in _PLACED]
    turned = any(_TURNED & body.attrib.keys() for body in bodies)
    placed = all({"pos", "fromto"} & element.attrib.keys() for element in inside)
    for compiler in root.iter("compiler"):
        if compiler.get("coordinate") == "global" and placed and not turned:
            del compiler.attrib["coordinate"]
            for body in bodies:
                body.attrib.pop("pos", None)
            yield _fate(
                compiler, "kept", "frames of bodies are W at the reference pose", "coordinate"
            )


def _read_as(text: str, count: int) -> str:
    """Give the numbers that a text begins with each word, or the text where they are not those."""
    text = DEFAULT.sub(r"\1", text)
    words = re.split(r"[\s,]+", text.strip(" \t\r\n,"))
    numbers = [found[0] for word in words if (found := _NUMBER.match(word))]
    if not count or len(numbers) < min(len(words), count) or text.split() == numbers[:count]:
        return text
    return " ".join(numbers[:count])


def _removed(
    parent: Element, child: Element, outcome: Outcome, reason: str, moves: bool = True
) -> Fate:
    parent.remove(child)
    place = child.get("name", "") or parent.get("name", "")
    return _fate(child, outcome, reason, place=place, moves=moves)


def _without(element: Element, attribute: str, reason: str, *, moves: bool = True) -> Fate:
    value, place = element.attrib.pop(attribute), element.get("name", "")
    told = f"{place}: {value}" if place else value
    return _fate(element, "dropped", reason, attribute, told, moves=moves)


def _fate(
    element: Element,
    outcome: Outcome,
    reason: str,
    attribute: str = "",
    place: str = "",
    *,
    moves: bool = True,
) -> Fate:
    properties = (attribute,) if attribute else ()
    return Fate(element.tag, properties, outcome, reason, moves, (place,) if place else ())
