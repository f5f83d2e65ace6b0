"""Collision shapes of bodies become contact spheres on the ground, one coefficient for all."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.scene import WORLD, ContactSphere, Ground

from .balls import BALLS
from .parts import Solid

FRICTION = 1.0
"""Of shapes whose format states none."""
NO_SPHERES = "no contact spheres stand for shapes of the kind"
_ROUNDED = 1e-12  # [m]


def contacts_of(
    shapes: tuple[Solid, ...], body_of: Callable[[int], str | None]
) -> tuple[tuple[ContactSphere, ...], Ground, list[Fate]]:
    """Give the spheres, what they touch, and what becomes of each shape.

    Args:
        shapes: Of the whole model.
        body_of: Names the body of the scene that a part is; none where it is not there.

    Raises:
        InputError: No shape can touch the ground.
    """
    fates, spheres, touching = [], [], []
    for shape in shapes:
        body = body_of(shape.part)
        if reason := _lost(shape, body):
            fates.append(Fate(shape.element, (), "dropped", reason, True, (shape.name,)))
            continue
        balls = BALLS[shape.kind](shape.size)
        places = shape.place + balls.centers @ shape.axes.T
        spheres += [ContactSphere(str(body), p.tolist(), balls.radius) for p in places]
        touching.append(shape)
        fates.append(
            Fate(shape.element, (), "approximated", balls.how, True,
                 (f"{shape.name}: {balls.short:.2g} m",))
            if balls.short
            else Fate(shape.element, (), "kept", balls.how, True, (shape.name,))
        )  # fmt: skip
    if not spheres:
        why = "; ".join(dict.fromkeys(fate.reason for fate in fates)) or "it has none"
        msg = f"--ground: no collision shape of it can touch the ground ({why}); leave it out"
        raise InputError(msg)
    return tuple(_outer(spheres)), *_ground(touching, fates)


def _outer(spheres: list[ContactSphere]) -> Iterator[ContactSphere]:
    """Leave out what is inside another sphere of its body, and so meets no plane by itself."""
    kept: dict[str, list[ContactSphere]] = defaultdict(list)
    for sphere in sorted(spheres, key=lambda each: -each.radius):
        others = kept[sphere.body]
        gaps = (o.radius - sphere.radius - math.dist(o.center, sphere.center) for o in others)
        if max(gaps, default=-1.0) < -_ROUNDED:
            others.append(sphere)
            yield sphere


def _lost(shape: Solid, body: str | None) -> str:
    if body in (None, WORLD):
        return "it is fixed in the world, where bodies meet the ground alone"
    if shape.kind not in BALLS:
        return f"{NO_SPHERES} {shape.kind}"
    return shape.apart


def _ground(touching: list[Solid], fates: list[Fate]) -> tuple[Ground, list[Fate]]:
    (label,) = {shape.element for shape in touching}
    counts = Counter(FRICTION if s.friction is None else s.friction for s in touching)
    most = max(counts, key=lambda value: (counts[value], value))
    others = tuple(f"{s.name}: {s.friction:g}" for s in touching if s.friction not in (None, most))
    said = "restitution, which the format does not state, is 0"
    if others:
        how = f"the ground has one coefficient, {most:g}, that of most shapes; {said}"
        fates.append(Fate(label, ("friction",), "approximated", how, True, others, len(others)))
    elif touching[0].friction is None:
        how = f"the format states none: a coefficient of {most:g}; {said}"
        fates.append(Fate(label, ("friction",), "approximated", how, True))
    else:
        how = f"a coefficient of {most:g} with the ground; {said}"
        fates.append(Fate(label, ("friction",), "kept", how, True))
    return Ground(most, 0.0), fates
