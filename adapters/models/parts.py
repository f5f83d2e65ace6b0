"""A model as readers produce it, whatever its format: moving parts and their freedoms."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import JointFacts, LinkFacts, ModelFacts

Property = float | tuple[float, float]
FAR = 1e9  # [rad or m]: no joint gets so far


def bounded(low: float, high: float) -> tuple[float, float] | None:
    """Return limits with ±1e9 for a side without one; None if both sides have none."""
    if not (abs(low) < FAR or abs(high) < FAR):
        return None
    return max(min(low, FAR), -FAR), max(min(high, FAR), -FAR)


@dataclass(frozen=True, eq=False)
class Mass:
    """Mass, centre of mass and inertia, placed in W at the reference pose."""

    mass: float
    com: Array
    """[m], shape (3,)."""
    inertia: Array
    """Inertia about the centre of mass, along the axes of W [kg·m²], shape (3, 3)."""

    def __add__(self, other: Mass) -> Mass:
        """Combine two masses."""
        mass = self.mass + other.mass
        if mass > 0:
            com = (self.mass * self.com + other.mass * other.com) / mass
        else:  # where the inertia is
            com = (self if self.inertia.any() else other).com
        inertia = sum(m.inertia + m.mass * _about(m.com - com) for m in (self, other))
        return Mass(mass, com, np.asarray(inertia))


def _about(arm: Array) -> Array:
    return np.asarray(arm @ arm * np.eye(3) - np.outer(arm, arm))


@dataclass(frozen=True, eq=False)
class Freedom:
    """One joint of a part; the coordinate is 0 at the reference pose."""

    name: str
    kind: Literal["hinge", "slider", "ball", "free"]
    anchor: Array
    """Anchor in W at the reference pose [m], shape (3,)."""
    axis: Array
    """Unit axis in W at the reference pose, shape (3,); zero if the kind has none."""
    properties: Mapping[str, Property] = field(default_factory=dict)
    """Nonzero properties, by field of `Joint`; coordinates count from the reference pose."""
    named: bool = True
    """Whether the file names it."""

    @property
    def facts(self) -> JointFacts:
        """What readers are compared by."""
        properties = {key: value for key, value in self.properties.items() if key != "rest"}
        return JointFacts(
            self.name,
            self.kind,
            self.anchor.tolist(),
            self.axis.tolist(),
            **properties,  # type: ignore[arg-type]
        )


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid part with its joints to the part that carries it."""

    name: str
    parent: int
    """Index of a part listed before; −1 is the world."""
    position: Array
    """Origin of the part's frame in W at the reference pose [m], shape (3,)."""
    orientation: Array
    """Rotation from the part's frame to W at the reference pose, wxyz."""
    mass: Mass
    freedoms: tuple[Freedom, ...]
    """Freedoms in order from the parent outwards; empty if fixed to it."""
    named: bool = True
    """Whether the file names it."""


CLOSES = "its joint closes a loop"
"""Reason why limits, and what acts in a joint, are dropped."""


@dataclass(frozen=True, eq=False)
class Closing:
    """A joint that closes a loop."""

    name: str
    kind: Literal["fixed", "hinge", "slider", "ball"]
    parts: tuple[int, int]
    anchor: Array
    """Anchor in W at the reference pose [m], shape (3,)."""
    axis: Array | None = None
    """Axis of a hinge or slider in W at the reference pose, shape (3,)."""
    element: str = "joint"
    """Element of the format that states it; equalities of MJCF are soft."""


@dataclass(frozen=True, eq=False)
class Line:
    """A massless line between two points: a spring and damper, or a link of constant length."""

    name: str
    parts: tuple[int, int]
    points: tuple[Array, Array]
    """End points in W at the reference pose [m], shape (3,) each."""
    length: float
    """Rest length of a spring, or constant length of a rigid line [m]."""
    stiffness: float = 0.0
    damping: float = 0.0
    rigid: bool = False


@dataclass(frozen=True)
class ModelCoupling:
    """A joint whose coordinate follows another's."""

    joint: str
    follows: str
    polynomial: tuple[float, ...]
    """Coefficients in the followed coordinate, constant first; both are 0 at the reference pose."""


@dataclass(frozen=True)
class Drive:
    """A motor that drives a hinge or slider to a target."""

    name: str
    joint: str
    stiffness: float
    damping: float
    position: float
    """Target coordinate [rad or m], counted from the reference pose."""
    velocity: float
    limit: float | None = None
    """Largest torque [N·m] or force [N], either way; None if unlimited."""
    limit_loss: str = ""
    """Reason why a limit of the file is not kept."""
    target: str = "at its command nearest to 0"
    """Description of the target, for the report."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A collision shape."""

    name: str
    part: int
    """Index of the part that the shape is fixed to; −1 is the world."""
    kind: str
    """A key of `contacts.BALLS`, "plane", or another word."""
    size: Array
    """Half-sizes as `contacts.BALLS` takes them [m], shape (3,)."""
    place: Array
    """Centre in W at the reference pose [m], shape (3,)."""
    axes: Array
    """Axes of the shape in W, as columns, shape (3, 3); the third is the normal of a plane."""
    own: Any = None
    """Data that the reader needs for `Solids.pair`."""


@dataclass(frozen=True)
class Pair:
    """Contact of a shape with the ground."""

    friction: float | None
    """Friction coefficient; None if the format states none."""
    restitution: float | None
    """Restitution coefficient; None if the format states none."""
    apart: str = ""
    """Reason why the shape passes through the ground; empty if it does not."""
    rolls: bool = False
    """Whether the file states torsional or rolling friction."""
    note: str = ""
    """Remark on a coefficient that has no effect."""


@dataclass(frozen=True, eq=False)
class Solids:
    """The collision shapes of a model."""

    element: str
    """The format's word for a shape."""
    shapes: tuple[Solid, ...]
    pair: Callable[[Solid, Solid | None], Pair]
    """Function of a shape and the plane that is the ground (None if the file has none)."""


@dataclass(frozen=True, eq=False)
class Parts:
    """A model, independent of its format."""

    name: str
    parts: tuple[Part, ...]
    gravity: Array
    """[m/s²], shape (3,)."""
    closings: tuple[Closing, ...] = ()
    couplings: tuple[ModelCoupling, ...] = ()
    lines: tuple[Line, ...] = ()
    labels: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    """Element and attribute in the format, by property of a freedom, "coupling" or "drive"."""
    drives: tuple[Drive, ...] = ()
    solids: Solids | None = None
    """Collision shapes; None if there is no ground."""

    @property
    def stated(self) -> frozenset[str]:
        """Properties that some freedom has."""
        freedoms = (freedom for part in self.parts for freedom in part.freedoms)
        return frozenset(key for freedom in freedoms for key in freedom.properties)

    @functools.cached_property
    def owners(self) -> list[int]:
        """Index of the part that each part, and at last the world, moves with; −1 is the world."""
        owners = [-1] * (len(self.parts) + 1)
        for k, part in enumerate(self.parts):
            owners[k] = k if part.freedoms else owners[part.parent]
        return owners

    def facts(self, reader: str) -> ModelFacts:
        """Return facts about named joints and named links that move, fixed to another or not."""
        owners = (self.parts[k].name if k >= 0 else "" for k in self.owners[:-1])
        holds = (closing.parts for closing in self.closings)
        parts = [(part, body) for part, body in zip(self.parts, owners, strict=True) if body]
        return ModelFacts(
            reader,
            tuple(
                LinkFacts.of(part.name, part.mass.mass, part.mass.com, part.mass.inertia, body)
                for part, body in parts
                if part.named
            ),
            tuple(freedom.facts for part, _ in parts for freedom in part.freedoms if freedom.named),
            len(self.couplings),
            sum(self.owners[one] != self.owners[other] for one, other in holds),
        )
