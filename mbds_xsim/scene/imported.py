"""A model of another format as it came in: its scene, and what became of all that its file says."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import Literal, Self

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Scene, Vector

Outcome = Literal["kept", "approximated", "dropped"]


class Fate(msgspec.Struct, frozen=True):
    """What became of one thing that a file says, wherever it says it."""

    element: str
    """As the format calls it."""
    properties: tuple[str, ...]
    """Attributes of the element; none: the element as a whole."""
    outcome: Outcome
    reason: str
    """How it is kept or approximated, or why it is dropped."""
    moves: bool
    """Whether it bears on the motion."""
    places: tuple[str, ...] = ()
    """Names of the elements, some with their values."""
    count: int = 1
    """Number of elements."""


class LinkFacts(msgspec.Struct, frozen=True):
    """Mass of a link that can move, in W at the reference pose."""

    name: str
    mass: float
    """[kg]"""
    com: Vector
    """[m]"""
    inertia: tuple[float, float, float, float, float, float]
    """xx, yy, zz, xy, xz, yz about the centre of mass [kg·m²]."""
    body: str = ""
    """Of the scene, that it is or is fixed to."""

    @classmethod
    def of(cls, name: str, mass: float, com: Array, inertia: Array, body: str = "") -> Self:
        """Take an inertia of shape (3, 3)."""
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
        return cls(name, float(mass), com.tolist(), (xx, yy, zz, xy, xz, yz), body)

    @property
    def tensor(self) -> Array:
        """The inertia, shape (3, 3)."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


class JointFacts(msgspec.Struct, frozen=True):
    """A joint with freedom, at the reference pose; zeros where it has none of something."""

    name: str
    kind: str
    """hinge, slider, ball, free, or another program's word."""
    anchor: Vector = (0.0, 0.0, 0.0)
    """In W [m]."""
    axis: Vector = (0.0, 0.0, 0.0)
    """In W."""
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    armature: float = 0.0
    limits: tuple[float, float] | None = None
    """Counted from the reference pose."""
    enforced: bool = True
    """Whether the limits hold, or are only remembered."""


class ModelFacts(msgspec.Struct, frozen=True):
    """What a reader makes of a model's file."""

    reader: str
    """Name and version."""
    links: tuple[LinkFacts, ...] = ()
    joints: tuple[JointFacts, ...] = ()
    couplings: int = 0
    """Joints that follow another."""


class Written(msgspec.Struct, frozen=True):
    """A scene in another format, with the report on what was lost."""

    text: str
    fates: tuple[Fate, ...]


class Imported(msgspec.Struct, frozen=True):
    """A scene made of a model, with the report on what was lost."""

    scene: Scene
    file: str
    format: str
    reader: str
    """Name and version of what has read it."""
    fates: tuple[Fate, ...]
    facts: ModelFacts
    """What the file says."""

    def count(self, outcome: Outcome) -> int:
        """Count the fates of an outcome that bear on the motion."""
        return sum(fate.outcome == outcome and fate.moves for fate in self.fates)


def gathered(fates: Iterable[Fate]) -> tuple[Fate, ...]:
    """Make one of all fates that differ in their places alone, losses first."""

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
