"""Collision shapes of bodies become contact spheres on the ground, with one friction for all."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator

from mbds_xsim.base import bounds
from mbds_xsim.base.errors import InputError, located
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.scene import WORLD, ContactSphere, Ground

from .balls import BALLS
from .floor import floor_fates
from .parts import Pair, Solid, Solids

NO_SPHERES = "no contact spheres stand for shapes of the kind"
_UNSTATED = {"friction": 1.0, "restitution": 0.0}
"""Of pairs for which the format states none."""
_ROUNDED = 1e-12  # [m]


def contacts_of(
    solids: Solids, floor: Solid | None, body_of: Callable[[int], str | None]
) -> tuple[tuple[ContactSphere, ...], Ground, list[Fate]]:
    """Give the spheres, what they touch, and what becomes of each shape.

    Args:
        solids: Of the whole model, with the ground at z = 0.
        floor: The plane that is the ground, where the file has it; None: it has none.
        body_of: Names the body of the scene that a part is; none where it is not there.

    Raises:
        InputError: No shape can touch the ground.
    """
    element = solids.element
    fates, spheres, touching = [*floor_fates(solids, floor)], [], []
    for shape in solids.shapes:
        if shape is floor:
            continue
        body, pair = body_of(shape.part), solids.pair(shape, floor)
        if reason := _lost(shape, body, pair):
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
        touching.append((shape.name, pair))
        fates.append(
            Fate(element, (), "approximated", balls.how, True,
                 (f"{shape.name}: {balls.short:.2g} m",))
            if balls.short
            else Fate(element, (), "kept", balls.how, True, (shape.name,))
        )  # fmt: skip
    if not spheres:
        lost = (fate.reason for fate in fates if not fate.properties)
        why = "; ".join(dict.fromkeys(lost)) or "it has none"
        msg = f"--ground: no collision shape of it can touch the ground ({why}); leave it out"
        raise InputError(msg)
    ground, more = _ground(element, touching)
    return tuple(_outer(spheres)), ground, [*fates, *more]


def _outer(spheres: list[ContactSphere]) -> Iterator[ContactSphere]:
    """Leave out what is inside another sphere of its body, and so meets no plane by itself."""
    kept: dict[str, list[ContactSphere]] = defaultdict(list)
    for sphere in sorted(spheres, key=lambda each: -each.radius):
        others = kept[sphere.body]
        gaps = (o.radius - sphere.radius - math.dist(o.center, sphere.center) for o in others)
        if max(gaps, default=-1.0) < -_ROUNDED:
            others.append(sphere)
            yield sphere


def _lost(shape: Solid, body: str | None, pair: Pair) -> str:
    if body in (None, WORLD):
        return "it is fixed in the world, where bodies meet the ground alone"
    if shape.kind not in BALLS:
        return f"{NO_SPHERES} {shape.kind}"
    return pair.apart


def _ground(element: str, touching: list[tuple[str, Pair]]) -> tuple[Ground, list[Fate]]:
    fates = []
    found = {}
    for key in _UNSTATED:
        stated = [(name, getattr(pair, key)) for name, pair in touching]
        found[key], fate = _common(element, key, stated)
        fates.append(fate)
    if rolling := tuple(name for name, pair in touching if pair.rolls):
        reason = "the ground has no torsional or rolling friction"
        fates.append(Fate(element, ("rolling",), "dropped", reason, True, rolling, len(rolling)))
    return Ground(**found), fates


def _common(element: str, key: str, stated: list[tuple[str, float | None]]) -> tuple[float, Fate]:
    """Give the value that most shapes have, and what becomes of the others'."""
    values = [(name, _UNSTATED[key] if value is None else value) for name, value in stated]
    counts = Counter(value for _, value in values)
    most = max(counts, key=lambda value: (counts[value], value))
    others = tuple(f"{name}: {value:g}" for name, value in values if value != most)
    if others:
        how = f"the ground has one value, {most:g}, that of most shapes"
        return most, Fate(element, (key,), "approximated", how, True, others, len(others))
    if stated[0][1] is None:
        how = f"the format states none with the ground: {most:g}"
        return most, Fate(element, (key,), "approximated", how, True)
    return most, Fate(element, (key,), "kept", f"{most:g} with the ground", True)
