"""Joints of SDF that close loops: DART's parser skips them, so they are read from the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.scene.imported import Fate

from .parts import CLOSES, Closing, Part, bounded
from .sdf_bodies import number, numbers, pose

_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slider", "ball": "ball",
          "fixed": "fixed"}  # fmt: skip
"""Kinds of joints by type, of the types that may close a loop."""
_LAWS = ("damping", "friction", "spring_stiffness", "spring_reference")


def closing_of(joint: Element, model: Element, parts: Sequence[Part], first: int) -> Closing | None:
    """Return a joint as one that closes a loop; None if its type or what it joins rules that out.

    Its pose is in the frame of its child, and its axis in its own frame or, if so stated, in that
    of the model. The links of the model are the parts from `first` on.
    """
    index = {part.name: first + k for k, part in enumerate(parts[first:])} | {"world": -1}
    above, below = (index.get(joint.findtext(end, "")) for end in ("parent", "child"))
    kind: Any = _KINDS.get(joint.get("type", ""))
    if kind is None or above is None or below is None:
        return None
    place, turn = np.zeros(3), np.eye(3)
    if below >= 0:
        place, turn = parts[below].position, rotation.matrix(parts[below].orientation)
    offset, axes = pose(joint)
    in_model = joint.findtext("axis/use_parent_model_frame", "").lower() in ("1", "true")
    frame = pose(model)[1] if in_model else turn @ axes
    axis = frame @ numbers(joint, "axis/xyz", (0.0, 0.0, 1.0))
    turning = axis if kind in ("hinge", "slider") else None
    return Closing(joint.get("name", ""), kind, (above, below), place + turn @ offset, turning)


def lost_of(joint: Element) -> Iterator[Fate]:
    """Report what acts in a joint or limits it, as one that closes a loop has none of it."""
    laws = [key for key in _LAWS if number(joint, f"axis/dynamics/{key}", 0.0)]
    low, high = (
        float(numbers(joint, f"axis/limit/{side}", (endless,), endless=True)[0])
        for side, endless in (("lower", -np.inf), ("upper", np.inf))
    )
    for key in laws if bounded(low, high) is None else [*laws, "lower"]:
        yield Fate(key, (), "dropped", CLOSES, True, (joint.get("name", ""),))
