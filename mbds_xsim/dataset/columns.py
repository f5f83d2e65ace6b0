"""Names of a trajectory's numbers where each has a column of its own, as in CSV files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.points import Points
from mbds_xsim.errors import InputError
from mbds_xsim.scene import Scene

__all__ = ["HELD", "TIME", "Group", "groups", "sort_columns"]

TIME = "time"
HELD = ("input/force", "input/torque")
"""Arrays of which a row holds from its frame to the next; that of the last frame means nothing."""


@dataclass(frozen=True, eq=False)
class Group:
    """The columns of one array."""

    name: str
    """Of the array, as in `docs/dataset-layout.md`."""
    columns: NDArray[np.str_]
    """In the shape of a frame of the array, (point or body or hinge, component)."""

    @property
    def span(self) -> str:
        """First and last column, for people."""
        names = self.columns.ravel()
        return f"{names[0]} … {names[-1]}" if len(names) > 1 else str(names[0])


def groups(scene: Scene) -> list[Group]:
    """Give the columns that a scene's trajectory may have; those without numbers are left out."""
    points = Points.of(scene)
    axes = ["xyz"[k] for k in points.axes]
    bodies, hinges = len(scene.bodies), len(points.mechanism.hinges)
    table = (
        ("position", "p{}_{}", len(points.body), axes),
        ("velocity", "p{}_v{}", len(points.body), axes),
        ("body/position", "b{}_{}", bodies, "xyz"),
        ("body/orientation", "b{}_q{}", bodies, "wxyz"),
        ("body/velocity", "b{}_v{}", bodies, "xyz"),
        ("body/angular_velocity", "b{}_w{}", bodies, "xyz"),
        ("input/force", "b{}_f{}", bodies, "xyz"),
        ("input/torque", "h{}_t{}", hinges, [""]),
    )
    return [
        Group(name, np.array([[form.format(k, c) for c in components] for k in range(count)]))
        for name, form, count, components in table
        if count
    ]


def sort_columns(scene: Scene, found: Iterable[str], source: str) -> list[Group]:
    """Tell which arrays the columns of a file are.

    Raises:
        InputError: A column is not known, time is missing, or an array is there in part.
    """
    allowed, got = groups(scene), list(found)
    twice = sorted({name for name in got if got.count(name) > 1})
    known = {TIME} | {str(name) for group in allowed for name in group.columns.ravel()}
    strange = [name for name in got if name not in known]
    if strange or twice or TIME not in got:
        spans = "; ".join(f"{group.span} ({group.name})" for group in allowed)
        wrong = f"column {(strange or twice)[0]!r}" if strange or twice else "no column 'time'"
        again = " twice" if twice and not strange else ""
        msg = f"{source}: got {wrong}{again}, allowed for {scene.name} are time; {spans}"
        raise InputError(msg)
    return [group for group in allowed if _is_given(group, set(got), source)]


def _is_given(group: Group, got: set[str], source: str) -> bool:
    missing = [name for name in group.columns.ravel() if name not in got]
    if missing and len(missing) < group.columns.size:
        msg = f"{source}: {group.name} needs the columns {group.span}, {missing[0]} is missing"
        raise InputError(msg)
    return not missing
