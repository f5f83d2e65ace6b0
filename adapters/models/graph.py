"""Bodies and joints in any order and sense become a tree, with what closes loops beside it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError

from .parts import Closing, Freedom, Mass, Part


@dataclass(frozen=True, eq=False)
class Node:
    """A body; see `Part`."""

    name: str
    position: Array
    orientation: Array
    mass: Mass


@dataclass(frozen=True, eq=False)
class Tie:
    """A joint between two bodies by position (−1 is the world)."""

    name: str
    ends: tuple[int, int]
    freedoms: tuple[Freedom, ...]
    """Of the second end relative to the first; none: fixed."""
    anchor: Array


def tree_of(nodes: list[Node], ties: list[Tie]) -> tuple[tuple[Part, ...], tuple[Closing, ...]]:
    """Take joints from the world outwards, nearest first; what is left over closes loops.

    Raises:
        InputError: A joint that closes a loop has several freedoms.
    """
    order: list[int] = []
    parts: list[Part] = []
    left = list(ties)
    reached = {-1: -1}
    while len(parts) < len(nodes):
        tie = next((t for t in left if (t.ends[0] in reached) != (t.ends[1] in reached)), None)
        if tie is None:  # nothing holds the next body
            body = next(k for k in range(len(nodes)) if k not in reached)
            free = Freedom(f"{nodes[body].name} floats", "free", nodes[body].position, np.zeros(3))
            parent = -1
            freedoms: tuple[Freedom, ...] = (free,)
        else:
            left.remove(tie)
            forward = tie.ends[0] in reached
            parent, body = tie.ends if forward else tie.ends[::-1]
            freedoms = tie.freedoms if forward else tuple(map(_turned, tie.freedoms[::-1]))
        node = nodes[body]
        reached[body] = len(parts)
        order.append(body)
        parts.append(
            Part(node.name, reached[parent], node.position, node.orientation, node.mass, freedoms)
        )
    return tuple(parts), tuple(_closing(tie, reached) for tie in left)


def _turned(freedom: Freedom) -> Freedom:
    """Give the same coordinate, of the first end relative to the second."""
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
