"""What a reader makes of a model's file: moving parts and the freedoms that each has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from mbds_xsim.base.arrays import Array

Property = float | tuple[float, float]


@dataclass(frozen=True, eq=False)
class Mass:
    """Mass, centre of mass and inertia, placed in W at the reference pose."""

    mass: float
    com: Array
    """[m], shape (3,)."""
    inertia: Array
    """About the centre of mass, along the axes of W [kg·m²], shape (3, 3)."""

    def __add__(self, other: Mass) -> Mass:
        """Give that of both together."""
        mass = self.mass + other.mass
        com = (self.mass * self.com + other.mass * other.com) / mass if mass > 0 else self.com
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
    """In W at the reference pose [m], shape (3,)."""
    axis: Array
    """Unit, in W at the reference pose, shape (3,); zero where the kind has none."""
    properties: Mapping[str, Property] = field(default_factory=dict)
    """Those that are not zero, by the names of `PROPERTIES`; places count from the reference
    pose."""
    named: bool = True
    """Whether the file names it."""


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid part with its joints to the part that carries it."""

    name: str
    parent: int
    """Position of a part listed before; −1 is the world."""
    position: Array
    """Origin of its frame in W at the reference pose [m], shape (3,)."""
    orientation: Array
    """Its frame to W, wxyz."""
    mass: Mass
    freedoms: tuple[Freedom, ...]
    """In the order in which they follow each other from the parent; none: fixed to it."""
    named: bool = True
    """Whether the file names it."""


@dataclass(frozen=True, eq=False)
class Closing:
    """What closes a loop."""

    name: str
    kind: Literal["fixed", "hinge", "slider", "ball"]
    parts: tuple[int, int]
    anchor: Array
    """In W at the reference pose [m], shape (3,)."""
    axis: Array | None = None
    """Of a hinge or slider."""


@dataclass(frozen=True, eq=False)
class Line:
    """A massless line between two points: a spring and damper, or of constant length."""

    name: str
    parts: tuple[int, int]
    points: tuple[Array, Array]
    """In W at the reference pose [m]."""
    length: float
    """Without force, or of a rigid one [m]."""
    stiffness: float = 0.0
    damping: float = 0.0
    rigid: bool = False


@dataclass(frozen=True)
class ModelCoupling:
    """A joint whose coordinate follows another's."""

    joint: str
    follows: str
    polynomial: tuple[float, ...]
    """Of the followed coordinate, from its constant term on; both are 0 at the reference pose."""


@dataclass(frozen=True)
class Drive:
    """A motor that leads a hinge or slider to a target."""

    name: str
    joint: str
    stiffness: float
    damping: float
    position: float
    """[rad or m], counted from the reference pose."""
    velocity: float
    limit: float | None = None
    """Of its torque [N·m] or force [N], either way."""
    unkept: str = ""
    """Why a limit of the file is not kept."""
    led: str = "at its command of 0"
    """To what, in words."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A collision shape."""

    name: str
    part: int
    """That it is fixed in; −1 is the world."""
    kind: str
    """A key of `balls.BALLS`, "plane", or another word."""
    size: Array
    """As `balls.BALLS` has it [m], shape (3,)."""
    place: Array
    """Of its middle in W at the reference pose [m], shape (3,)."""
    axes: Array
    """Its own in W, as columns, shape (3, 3); the third is the normal of a plane."""
    own: Any = None
    """What its reader knows of how it touches others."""


@dataclass(frozen=True)
class Pair:
    """How a shape meets the ground."""

    friction: float | None
    """Coefficient; None: the format states none."""
    restitution: float | None
    """None: the format states none."""
    apart: str = ""
    """Why the shape passes through the ground."""
    rolls: bool = False
    """Whether it has torsional or rolling friction there."""
    note: str = ""
    """What of both has no effect."""


@dataclass(frozen=True, eq=False)
class Solids:
    """The collision shapes of a model."""

    element: str
    """What the format calls one."""
    shapes: tuple[Solid, ...]
    pair: Callable[[Solid, Solid | None], Pair]
    """Takes a shape and the plane that is the ground; None: the file has none."""


@dataclass(frozen=True, eq=False)
class Parts:
    """A model without its format."""

    name: str
    parts: tuple[Part, ...]
    gravity: Array
    """[m/s²], shape (3,)."""
    closings: tuple[Closing, ...] = ()
    couplings: tuple[ModelCoupling, ...] = ()
    lines: tuple[Line, ...] = ()
    labels: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    """Element and attribute that the format has for each property of a freedom."""
    drives: tuple[Drive, ...] = ()
    solids: Solids | None = None
    """None: there is no ground."""
