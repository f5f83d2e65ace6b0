"""Conversion of collision shapes into contact spheres on a ground at z = 0 with one friction."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from mbds_xsim.base import bounds
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, located
from mbds_xsim.scene.imported import Fate, Outcome
from mbds_xsim.scene.scene import WORLD, ContactSphere, Ground

from .parts import Line, Pair, Part, Parts, Solid, Solids

NO_SPHERES = "no contact spheres stand for shapes of the kind"
_UNSTATED = {"friction": 1.0, "restitution": 0.0}
"""Values for pairs for which the format states none."""
_ROUNDED = 1e-12  # [m]
_LEVEL = 1.0 - 1e-9  # least vertical part of the unit normal of a horizontal plane
_SHARE = 0.1
"""Radius of the spheres in corners and rims of a shape, over its smallest half-size."""
_RIM = 8
"""Number of spheres in each rim of a cylinder. Half-way between two of them, up to 7.6 % of the
cylinder's radius is missing."""


@dataclass(frozen=True, eq=False)
class Balls:
    """Spheres of equal radius inside a shape."""

    centers: Array
    """Centres in the shape's frame [m], shape (sphere, 3)."""
    radius: float
    """[m]"""
    short: float = 0.0
    """Largest amount by which a plane can be nearer to the shape than to the spheres [m]."""
    how: str = ""
    """Description for the report."""


def _sphere(size: Array) -> Balls:
    return Balls(np.zeros((1, 3)), float(size[0]), how="a contact sphere")


def _capsule(size: Array) -> Balls:
    ends = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
    return Balls(ends, float(size[0]), how="the spheres of its ends, which meet a plane as it does")


def _box(size: Array) -> Balls:
    # Along n, a corner's sphere falls short by r (|n|₁ − 1): 0 on a face, most on the diagonal.
    radius = _SHARE * float(size.min())
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * (size - radius)
    how = "eight spheres in its corners, which touch its faces; it lacks at most what is said"
    return Balls(corners, radius, (math.sqrt(3.0) - 1.0) * radius, how)


def _cylinder(size: Array) -> Balls:
    radius = _SHARE * float(size[:2].min())
    ring, height = size[:2] - radius
    angles = 2.0 * np.pi / _RIM * np.arange(_RIM)
    rim = ring * np.column_stack([np.cos(angles), np.sin(angles)])
    centers = [np.column_stack([rim, np.full(_RIM, z)]) for z in (-height, height)]
    short = ring * (1.0 - math.cos(math.pi / _RIM)) + (math.sqrt(2.0) - 1.0) * radius
    how = f"{_RIM} spheres in each rim, exact on its ends; it lacks at most what is said"
    return Balls(np.concatenate(centers), radius, float(short), how)


BALLS: Mapping[str, Callable[[Array], Balls]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "cylinder": _cylinder,
}
"""Spheres by kind of shape, from half-sizes: radius; radius and half-length along z; x, y and z."""


def contacts_of(
    solids: Solids, floor: Solid | None, body_of: Callable[[int], str | None]
) -> tuple[tuple[ContactSphere, ...], Ground, list[Fate]]:
    """Return the contact spheres, the ground, and the fate of each shape.

    Args:
        solids: Shapes of the whole model, with the ground at z = 0.
        floor: Plane in the file that is the ground; None if it has none.
        body_of: Returns the body of the scene that a part belongs to; None if it was dropped.

    Raises:
        InputError: No shape can touch the ground.
    """
    element = solids.element
    fates, spheres, pairs = [*_floor_fates(solids, floor)], [], []
    for shape in solids.shapes:
        if shape is floor:
            continue
        body, pair = body_of(shape.part), solids.pair(shape, floor)
        if reason := _drop_reason(shape, body, pair):
            fates.append(Fate(element, (), "dropped", reason, True, (shape.name,)))
            continue
        if pair.note:
            fates.append(Fate(element, (), "kept", pair.note, True, (shape.name,)))
        balls = BALLS[shape.kind](shape.size)
        places = shape.place + balls.centers @ shape.axes.T
        with located(f"{element} {shape.name!r}"):
            bounds.at_least_zero("friction with the ground", pair.friction or 0.0)
            bounds.share("restitution on the ground", pair.restitution or 0.0)
            spheres += [ContactSphere(str(body), p.tolist(), balls.radius) for p in places]
        pairs.append((shape.name, pair))
        outcome: Outcome = "approximated" if balls.short else "kept"
        place = f"{shape.name}: {balls.short:.2g} m" if balls.short else shape.name
        fates.append(Fate(element, (), outcome, balls.how, True, (place,)))
    if not spheres:
        reasons = (fate.reason for fate in fates if not fate.properties)
        cause = "; ".join(dict.fromkeys(reasons)) or "it has none"
        msg = f"--ground: no collision shape of it can touch the ground ({cause}); leave it out"
        raise InputError(msg)
    ground, ground_fates = _ground(element, pairs)
    return tuple(_outer(spheres)), ground, [*fates, *ground_fates]


def _outer(spheres: list[ContactSphere]) -> Iterator[ContactSphere]:
    """Yield the spheres not inside another one of their body: no others can touch a plane."""
    by_body: dict[str, list[ContactSphere]] = defaultdict(list)
    for sphere in sorted(spheres, key=lambda each: -each.radius):
        others = by_body[sphere.body]
        gaps = (o.radius - sphere.radius - math.dist(o.center, sphere.center) for o in others)
        if max(gaps, default=-1.0) < -_ROUNDED:
            others.append(sphere)
            yield sphere


def _drop_reason(shape: Solid, body: str | None, pair: Pair) -> str:
    if body is None:
        return "its body has no mass and is left out"
    if body == WORLD:
        return "it is fixed in the world, and bodies touch only the ground"
    if shape.kind not in BALLS:
        return f"{NO_SPHERES} {shape.kind}"
    return pair.apart


def _ground(element: str, pairs: list[tuple[str, Pair]]) -> tuple[Ground, list[Fate]]:
    coefficients = {}
    reason = "the ground has no torsional or rolling friction"
    rolling = [name for name, pair in pairs if pair.rolls]
    fates = [Fate(element, ("rolling",), "dropped", reason, True, (name,)) for name in rolling]
    for key in _UNSTATED:
        stated = [(name, getattr(pair, key)) for name, pair in pairs]
        coefficients[key], fate = _common(element, key, stated)
        fates.append(fate)
    return Ground(**coefficients), fates


def _common(element: str, key: str, stated: list[tuple[str, float | None]]) -> tuple[float, Fate]:
    """Return the value that most shapes have, and its fate, with the shapes that differ."""
    values = [(name, _UNSTATED[key] if value is None else value) for name, value in stated]
    counts = Counter(value for _, value in values)
    most = max(counts, key=lambda value: (counts[value], value))
    others = tuple(f"{name}: {value:g}" for name, value in values if value != most)
    outcome: Outcome = "approximated"
    if others:
        reason = f"the ground has one value, {most:g}, that of most shapes"
    elif stated[0][1] is None:
        reason = f"the format states none with the ground: {most:g}"
    else:
        outcome, reason = "kept", f"{most:g} with the ground"
    return most, Fate(element, (key,), outcome, reason, True, others, len(others) or 1)


def floor_of(model: Parts) -> Solid | None:
    """Return the first horizontal plane that is fixed in the world; None if there is none."""
    shapes = model.solids.shapes if model.solids is not None else ()
    planes = (s for s in shapes if s.kind == "plane" and s.axes[2, 2] > _LEVEL)
    return next((plane for plane in planes if model.owners[plane.part] < 0), None)


def on_the_floor(model: Parts, floor: Solid | None) -> Parts:
    """Return the model shifted so that the ground is at z = 0; the plane itself keeps its place."""
    if model.solids is None or floor is None or not floor.place[2]:
        return model
    bounds.finite(f"place of {floor.name!r}", tuple(floor.place.tolist()))
    shift = np.array([0.0, 0.0, -floor.place[2]])

    def part(each: Part) -> Part:
        mass = replace(each.mass, com=each.mass.com + shift)
        freedoms = tuple(replace(own, anchor=own.anchor + shift) for own in each.freedoms)
        return replace(each, position=each.position + shift, mass=mass, freedoms=freedoms)

    def line(each: Line) -> Line:
        return replace(each, points=(each.points[0] + shift, each.points[1] + shift))

    def shape(each: Solid) -> Solid:
        return each if each is floor else replace(each, place=each.place + shift)

    return replace(
        model,
        parts=tuple(map(part, model.parts)),
        closings=tuple(replace(each, anchor=each.anchor + shift) for each in model.closings),
        lines=tuple(map(line, model.lines)),
        solids=replace(model.solids, shapes=tuple(map(shape, model.solids.shapes))),
    )


def _floor_fates(solids: Solids, floor: Solid | None) -> Iterator[Fate]:
    """Report which plane is the ground, and that bodies collide with nothing else."""
    if floor is not None:
        note = f"the ground, z = 0, which in the file is at z = {floor.place[2]:g} m"
        yield Fate(solids.element, ("plane",), "kept", note, True, (floor.name,))
    else:
        note = "no horizontal plane is fixed in the world: the ground is the plane z = 0"
        yield Fate(solids.element, ("plane",), "approximated", note, True)
    names = tuple(shape.name for shape in solids.shapes if shape is not floor)
    if len(names) > 1:
        reason = "collisions between bodies are not imported; a scene file can add [collisions]"
        yield Fate(solids.element, ("contact",), "dropped", reason, True, names, len(names))
