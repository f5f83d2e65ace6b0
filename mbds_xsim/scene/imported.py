"""A model imported from another format: its scene, and the fate of everything in its file."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import Literal, Self

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Scene, Vector

Outcome = Literal["kept", "approximated", "dropped"]
FIXED = "fixed in the world, where its mass moves nothing"
"""Reason of what is kept of a part with mass that no joint moves."""


class Fate(msgspec.Struct, frozen=True):
    """Outcome of converting one kind of element, wherever a file contains it."""

    element: str
    """Name of the element in the format."""
    properties: tuple[str, ...]
    """Attributes of the element; empty for the element as a whole."""
    outcome: Outcome
    reason: str
    """Explanation of how it is kept or approximated, or why it is dropped."""
    moves: bool
    """Whether it affects the motion."""
    places: tuple[str, ...] = ()
    """Names of the elements, some with their values."""
    count: int = 1
    """Number of elements."""


class LinkFacts(msgspec.Struct, frozen=True):
    """Mass properties of a movable link, in W at the reference pose."""

    name: str
    mass: float
    """Mass [kg]."""
    com: Vector
    """Centre of mass in W [m]."""
    inertia: tuple[float, float, float, float, float, float]
    """Inertia xx, yy, zz, xy, xz, yz about the centre of mass [kg·m²]."""
    body: str = ""
    """Body of the scene that the link is or is fixed to."""

    @classmethod
    def of(cls, name: str, mass: float, com: Array, inertia: Array, body: str = "") -> Self:
        """Make the facts from an inertia tensor of shape (3, 3)."""
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
        return cls(name, float(mass), com.tolist(), (xx, yy, zz, xy, xz, yz), body)

    @property
    def tensor(self) -> Array:
        """Inertia tensor about the centre of mass [kg·m²], shape (3, 3)."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


class JointFacts(msgspec.Struct, frozen=True):
    """A joint that allows motion, at the reference pose; properties that it lacks are zero."""

    name: str
    kind: str
    """Kind: hinge, slider, ball, free, or another program's name for it."""
    anchor: Vector = (0.0, 0.0, 0.0)
    """Anchor in W [m]."""
    axis: Vector = (0.0, 0.0, 0.0)
    """Axis in W."""
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    armature: float = 0.0
    limits: tuple[float, float] | None = None
    """Lower and upper limit, measured from the reference pose."""
    enforced: bool = True
    """Whether the limits act; otherwise they are only recorded."""


class ModelFacts(msgspec.Struct, frozen=True):
    """Contents of a model's file, as a reader understands it."""

    reader: str
    """Name and version of the reader."""
    links: tuple[LinkFacts, ...] = ()
    joints: tuple[JointFacts, ...] = ()
    couplings: int = 0
    """Number of joints that follow another."""
    loops: int = 0
    """Number of constraints that close loops."""


class Written(msgspec.Struct, frozen=True):
    """A scene in another format, with a report on losses."""

    text: str
    fates: tuple[Fate, ...]


class Imported(msgspec.Struct, frozen=True):
    """A scene made from a model, with a report on losses."""

    scene: Scene
    file: str
    format: str
    reader: str
    """Name and version of the reader."""
    fates: tuple[Fate, ...]
    facts: ModelFacts
    """Contents of the file."""

    def count(self, outcome: Outcome) -> int:
        """Count the fates with an outcome that affect the motion."""
        return sum(fate.outcome == outcome and fate.moves for fate in self.fates)


def gathered(fates: Iterable[Fate]) -> tuple[Fate, ...]:
    """Merge fates that differ only in their places, sorted by effect on motion, then by loss."""

    def alike(fate: Fate) -> tuple[object, ...]:
        order = ("dropped", "approximated", "kept").index(fate.outcome)
        return (not fate.moves, order, fate.element, fate.properties, fate.reason)

    groups = (list(group) for _, group in groupby(sorted(fates, key=alike), key=alike))
    return tuple(
        msgspec.structs.replace(
            group[0],
            places=tuple(dict.fromkeys(place for fate in group for place in fate.places)),
            count=sum(fate.count for fate in group),
        )
        for group in groups
    )
