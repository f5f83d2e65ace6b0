"""Conversion of collision shapes into contact spheres on a ground with one friction."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator

from mbds_xsim.base import bounds
from mbds_xsim.base.errors import InputError, located
from mbds_xsim.scene.imported import Fate, Outcome
from mbds_xsim.scene.scene import WORLD, ContactSphere, Ground

from .balls import BALLS
from .floor import floor_fates
from .parts import Pair, Solid, Solids

NO_SPHERES = "no contact spheres stand for shapes of the kind"
_UNSTATED = {"friction": 1.0, "restitution": 0.0}
"""Values for pairs for which the format states none."""
_ROUNDED = 1e-12  # [m]


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
    fates, spheres, pairs = [*floor_fates(solids, floor)], [], []
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
    if body in (None, WORLD):
        return "it is fixed in the world, and bodies touch only the ground"
    if shape.kind not in BALLS:
        return f"{NO_SPHERES} {shape.kind}"
    return pair.apart


def _ground(element: str, pairs: list[tuple[str, Pair]]) -> tuple[Ground, list[Fate]]:
    fates = []
    coefficients = {}
    for key in _UNSTATED:
        stated = [(name, getattr(pair, key)) for name, pair in pairs]
        coefficients[key], fate = _common(element, key, stated)
        fates.append(fate)
    if rolling := tuple(name for name, pair in pairs if pair.rolls):
        reason = "the ground has no torsional or rolling friction"
        fates.append(Fate(element, ("rolling",), "dropped", reason, True, rolling, len(rolling)))
    return Ground(**coefficients), fates


def _common(element: str, key: str, stated: list[tuple[str, float | None]]) -> tuple[float, Fate]:
    """Return the value that most shapes have, and its fate, with the shapes that differ."""
    values = [(name, _UNSTATED[key] if value is None else value) for name, value in stated]
    counts = Counter(value for _, value in values)
    most = max(counts, key=lambda value: (counts[value], value))
    others = tuple(f"{name}: {value:g}" for name, value in values if value != most)
    if others:
        reason = f"the ground has one value, {most:g}, that of most shapes"
        return most, Fate(element, (key,), "approximated", reason, True, others, len(others))
    if stated[0][1] is None:
        reason = f"the format states none with the ground: {most:g}"
        return most, Fate(element, (key,), "approximated", reason, True)
    return most, Fate(element, (key,), "kept", f"{most:g} with the ground", True)
