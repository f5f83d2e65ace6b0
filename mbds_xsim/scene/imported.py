"""A model of another format as it came in: its scene, and what became of all that its file says."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import Literal

import msgspec

from mbds_xsim.scene.scene import Scene

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


class Imported(msgspec.Struct, frozen=True):
    """A scene made of a model, with the report on what was lost."""

    scene: Scene
    file: str
    format: str
    reader: str
    """Name and version of what has read it."""
    fates: tuple[Fate, ...]

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
