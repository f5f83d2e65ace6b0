"""Spanning tree of bodies and joints given in any order and sense; other joints close loops."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError

from .parts import Closing, Freedom, Part


@dataclass(frozen=True, eq=False)
class Tie:
    """A joint between two bodies, given by index (−1 is the world)."""

    name: str
    ends: tuple[int, int]
    freedoms: tuple[Freedom, ...]
    """Freedoms of the second end relative to the first; empty if the joint is fixed."""
    anchor: Array


def tree_of(bodies: list[Part], ties: list[Tie]) -> tuple[tuple[Part, ...], tuple[Closing, ...]]:
    """Grow a tree of joints from the world, in their given order; the remaining ones close loops.

    Args:
        bodies: Parts without parents and freedoms.
        ties: Joints between any two of them, or one and the world.

    Raises:
        InputError: A joint that closes a loop has several freedoms.
    """
    parts: list[Part] = []
    remaining = list(ties)
    reached = {-1: -1}
    while len(parts) < len(bodies):
        tie = next((t for t in remaining if (t.ends[0] in reached) != (t.ends[1] in reached)), None)
        if tie is None:  # no joint leads to the next body
            parent, body = -1, next(k for k in range(len(bodies)) if k not in reached)
            name, place = f"{bodies[body].name} floats", bodies[body].position
            freedoms: tuple[Freedom, ...] = (Freedom(name, "free", place, np.zeros(3)),)
        else:
            remaining.remove(tie)
            forward = tie.ends[0] in reached
            parent, body = tie.ends if forward else tie.ends[::-1]
            freedoms = tie.freedoms if forward else tuple(map(_reverse, tie.freedoms[::-1]))
        reached[body] = len(parts)
        above = reached[parent]
        parts.append(dataclasses.replace(bodies[body], parent=above, freedoms=freedoms))
    return tuple(parts), tuple(_closing(tie, reached) for tie in remaining)


def _reverse(freedom: Freedom) -> Freedom:
    """Return the freedom with the same coordinate, of the first end relative to the second."""
    return dataclasses.replace(freedom, axis=-freedom.axis)


def _closing(tie: Tie, reached: dict[int, int]) -> Closing:
    ends = (reached[tie.ends[0]], reached[tie.ends[1]])
    if not tie.freedoms:
        return Closing(tie.name, "fixed", ends, tie.anchor)
    if len(tie.freedoms) > 1 or tie.freedoms[0].kind == "free":
        msg = f"the joint {tie.name!r} closes a loop, for which it has too many freedoms"
        raise InputError(msg)
    (freedom,) = tie.freedoms
    axis = freedom.axis if freedom.axis.any() else None
    return Closing(tie.name, freedom.kind, ends, tie.anchor, axis)  # type: ignore[arg-type]


def check_unique(model: Element, tag: str) -> None:
    """Raise InputError if two elements of a kind in a model have the same name."""
    names = Counter(each.get("name", "") for each in model.findall(tag))
    for repeated in (name for name, count in names.items() if count > 1):
        where = f"<{model.tag}> {model.get('name', '')!r}"
        raise InputError(f"{where} has two {tag}s called {repeated!r}, allowed is one")


def check_circles(model: Element, above: Mapping[str, Collection[str]]) -> None:
    """Raise InputError if joints hold links in a circle; `above` has the parents of each link."""
    try:
        TopologicalSorter(above).prepare()
    except CycleError as error:
        circle = ", ".join(map(repr, error.args[1]))
        where = f"joints of <{model.tag}> {model.get('name', '')!r}"
        msg = f"{where} hold links in a circle: {circle}; let one of them have another child"
        raise InputError(msg) from error
