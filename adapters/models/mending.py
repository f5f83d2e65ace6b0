"""Repairs of MJCF and URDF that older or lax readers accept, but MuJoCo's compiler does not.

Each repair changes the document and is listed in the report. Anything ambiguous stays as it is, for
the compiler to refuse.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement, tostring

from mbds_xsim.scene.imported import Fate, Outcome

from .source import DEFAULT

_SINGLE_NUMBERS = (
    *("value", "lower", "upper", "effort", "velocity", "damping", "friction"),
    *("multiplier", "offset", "ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
)
_NUMBERS = {"xyz": 3, "rpy": 3} | dict.fromkeys(_SINGLE_NUMBERS, 1)
"""URDF attributes, with the number of values that each has."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_SINGLE = {"inertial", "mass", "inertia", "origin", "axis", "limit", "dynamics", "mimic"}
_UNRECOGNIZED = re.compile(r"unrecognized attribute: '([^']+)'\s+Element '([^']+)', line (\d+)")
_ORIENTATIONS = {"quat", "axisangle", "xyaxes", "zaxis", "euler"}
_TWICE = "drawn only; defined twice"
_LOCAL = "frames of bodies are W at the reference pose"
_POSITIONED = ("joint", "geom", "site", "inertial")


def mend_urdf(root: Element) -> Iterator[Fate]:
    """Repair a URDF document, and report each repair."""
    for holder in root:
        place = holder.get("name", "")
        for parent in (holder, *holder.findall("inertial")):
            for element in parent:
                if element.tag in _SINGLE:
                    yield from _clean_numbers(element, place)
            yield from _remove_duplicates(parent, place)
        if holder.tag == "link" and place == "world":
            for element in holder.findall("inertial"):
                yield _remove(holder, element, "kept", "the world does not move")
    yield from _free_from_root(root)


def _free_from_root(root: Element) -> Iterator[Fate]:
    """Let what floats on a root link float in the world, as MuJoCo's compiler wants it."""
    carried = {child.get("link") for child in root.findall("joint/child")} | {"world", None}
    for joint in root.findall("joint[@type='floating']"):
        for parent in joint.findall("parent"):
            if parent.get("link") not in carried:
                parent.set("link", "world")
                yield _fate(joint, "kept", "it floats in the world", joint.get("name", ""))
    on_world = root.find("*/parent[@link='world']") is not None
    if on_world and root.find("link[@name='world']") is None:
        SubElement(root, "link", name="world")


def _clean_numbers(element: Element, place: str) -> Iterator[Fate]:
    for key, text in element.attrib.items():
        if (plain := _leading_numbers(text, _NUMBERS.get(key, 0))) != text:
            element.set(key, plain)
            detail = f"{place}: {text} read as {plain}"
            yield _fate(element, "approximated", "not plain numbers", detail, key)


def _remove_duplicates(parent: Element, place: str) -> Iterator[Fate]:
    firsts: dict[str, Element] = {}
    for element in list(parent):
        first = firsts.setdefault(element.tag, element)
        if first is not element and element.tag in _SINGLE:
            parent.remove(element)
            outcome: Outcome = "kept" if first.attrib == element.attrib else "approximated"
            yield _fate(element, outcome, "stated again; the first counts", place)


def mend_mjcf(root: Element) -> Iterator[Fate]:
    """Repair an MJCF document, except for attributes unknown to the compiler."""
    yield from _make_local(root)
    settings = {key: value for c in root.iter("compiler") for key, value in c.attrib.items()}
    materials = {"", *(element.get("name", "") for element in root.iter("material"))}
    assets: set[tuple[str, str]] = set()
    for parent in root.iter():
        for child in list(parent):
            if child.get("material", "") not in materials:
                yield _strip(child, "material", "there is no such material", moves=False)
            if parent.tag == "asset" and child.tag in ("material", "texture"):
                if (asset := (child.tag, child.get("name", ""))) in assets and asset[1]:
                    yield _remove(parent, child, "dropped", _TWICE, moves=False)
                assets.add(asset)
            if child.tag == "joint" and child.get("type") == "fixed":
                yield _remove(parent, child, "kept", "no freedom at all")
            if child.tag == "inertial" and settings.get("inertiafromgeom") == "true":
                reason = "the compiler is told to take masses from geometry"
                yield _remove(parent, child, "dropped", reason)


def in_lines(root: Element) -> str:
    """Write a document with one element in each line, so that a line tells which one it is."""
    for parent in root.iter():
        parent.text = "\n" if len(parent) else None
        for child in parent:
            child.tail = "\n" if child is not parent[-1] else None
    return tostring(root, encoding="unicode")


def remove_unknown(root: Element, complaint: str) -> Iterator[Fate]:
    """Remove the attribute that a compiler calls unrecognized, and from all elements of this kind.

    Elements of one tag, such as joints of bodies and of equalities, differ by their parents.

    Args:
        root: The document.
        complaint: The compiler's message about `in_lines(root)`.
    """
    holders = {child: parent.tag for parent in root.iter() for child in parent}
    for attribute, tag, line in _UNRECOGNIZED.findall(complaint):
        named = [*root.iter()][int(line) - 1 : int(line)]
        places = {holders.get(each) for each in named if each.tag == tag}
        for element in root.iter(tag):
            if attribute in element.attrib and holders.get(element) in places:
                yield _strip(element, attribute, "unknown to MuJoCo's compiler")


def _make_local(root: Element) -> Iterator[Fate]:
    """Rewrite global coordinates, if possible, as local ones in body frames equal to W."""
    bodies = [*root.iter("body")]
    children = [child for body in bodies for child in body if child.tag in _POSITIONED]
    turned = any(_ORIENTATIONS & body.attrib.keys() for body in bodies)
    placed = all({"pos", "fromto"} & element.attrib.keys() for element in children)
    for compiler in root.iter("compiler"):
        if compiler.get("coordinate") == "global" and placed and not turned:
            del compiler.attrib["coordinate"]
            for body in bodies:
                body.attrib.pop("pos", None)
            yield _fate(compiler, "kept", _LOCAL, "", "coordinate")


def _leading_numbers(text: str, count: int) -> str:
    """Return the leading number of each word, `count` at most, or the text if there are too few."""
    text = DEFAULT.sub(r"\1", text)
    words = re.split(r"[\s,]+", text.strip(" \t\r\n,"))
    numbers = [match[0] for word in words if (match := _NUMBER.match(word))]
    if not count or len(numbers) < min(len(words), count) or text.split() == numbers[:count]:
        return text
    return " ".join(numbers[:count])


def _remove(
    parent: Element, child: Element, outcome: Outcome, reason: str, *, moves: bool = True
) -> Fate:
    parent.remove(child)
    place = child.get("name", "") or parent.get("name", "")
    return _fate(child, outcome, reason, place, moves=moves)


def _strip(element: Element, attribute: str, reason: str, *, moves: bool = True) -> Fate:
    value, place = element.attrib.pop(attribute), element.get("name", "")
    detail = f"{place}: {value}" if place else value
    return _fate(element, "dropped", reason, detail, attribute, moves=moves)


def _fate(
    element: Element, outcome: Outcome, reason: str, place: str, *keys: str, moves: bool = True
) -> Fate:
    return Fate(element.tag, keys, outcome, reason, moves, (place,) if place else ())
