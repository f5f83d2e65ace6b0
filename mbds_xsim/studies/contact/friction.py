"""Friction that engines deliver: on what slides, in which direction, and on what should stand.

The coefficient is the horizontal impulse over the vertical one, so that a body that hops shows it
in its hop. Drag that a profile has counts as friction: what slides knows no difference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Ground, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.studies.contact import (
    CRATE_MASS,
    FRICTION,
    PULL,
    RADIUS,
    RESTITUTION,
    ContactBench,
    ContactFigure,
    ball,
    crate,
    wheel,
)

_BALL_GROUND = Ground(FRICTION, RESTITUTION)
# Corners that rebound from each other's pushes would rattle.
_CRATE_GROUND = Ground(FRICTION, 0.0)
HEADINGS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)
"""Of the slip from the x axis [°]."""
_CRATE_HEADINGS = (0.0, 45.0)
PUSHES = (0.6, 0.7, 0.8, 0.9, 1.05, 1.2, 1.4, 1.5)
"""Held forces over the largest that friction bears, from small to large."""
_HELD = 0.9
_SLIDES = 0.02  # what a push so much above the limit makes it faster by is no creep
_PUSHED = 0.4  # [s]
_CREEPS_FROM = 0.2  # what sets itself at the start is over by then [s]
_FRAME = 0.02
_CARRIED = 0.05  # of the weight


class Slide(NamedTuple):
    """What slides, how, and when it is looked at."""

    what: str
    make: Callable[..., tuple[Scene, Batch]]
    ground: Ground
    headings: tuple[float, ...]
    speed: float
    frame: float
    window: tuple[float, float]
    """Times between which it slides all the time [s]."""
    duration: float


# It slides for 0.339 s, and 0.240 s in a box.
_BALL = Slide("ball", ball, _BALL_GROUND, HEADINGS, 5.0, _FRAME, (0.06, 0.22), 0.38)
# So fast that friction does not turn the slip, and so short that the wheel does not turn aside:
# what is harder to move along one axis than along the other must not matter to friction.
_WHEEL = Slide("wheel", wheel, _BALL_GROUND, HEADINGS, 20.0, 0.005, (0.005, 0.02), 0.02)
# It slides for 0.474 s, and 0.335 s in a box.
_CRATE = Slide("crate", crate, _CRATE_GROUND, _CRATE_HEADINGS, 2.0, _FRAME, (0.1, 0.3), 0.3)


def friction(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure friction on a sliding ball, wheel and crate; a pushed crate's creep and start."""
    on_balls, on_points = (ContactBench(engine, profile, s) for s in ("ballscroll", "simplecubli"))
    motion, found = _slid(on_balls, _BALL)
    hop = np.nanmax(motion.position[:, :, 0, 2] - RADIUS)
    return [
        *found,
        on_balls.measured("ball: hops while it slides", "m", hop, motion),
        *_slid(ContactBench(engine, profile, "particlecar"), _WHEEL)[1],
        *_slid(on_points, _CRATE)[1],
        *(m for heading in _CRATE_HEADINGS for m in _pushed_crate(on_points, heading)),
    ]


def sliding(motion: Trajectory, along: Array, window: tuple[float, float]) -> tuple[Array, Array]:
    """Give the coefficient of friction, and how far it is aside of the slip [°], each (row,).

    Args:
        motion: Of one body.
        along: Direction of the slip at the start, shape (row, 3).
        window: Times between which it slides all the time [s].

    Returns:
        NaN where the ground does not carry the body.
    """
    begin, end = np.searchsorted(motion.time, np.array(window) - 1e-9)
    change = motion.velocity[:, end, 0] - motion.velocity[:, begin, 0]
    lift = change[:, 2] + PULL * (motion.time[end] - motion.time[begin])
    # What has hopped off shows no friction.
    carried = lift > _CARRIED * PULL * (motion.time[end] - motion.time[begin])
    back = np.where(carried, -np.sum(change * along, axis=1), np.nan)
    aside = np.abs(np.cross(along, change)[:, 2])
    return back / lift, np.degrees(np.arctan2(aside, back))


def _slid(bench: ContactBench, slide: Slide) -> tuple[Trajectory, list[ContactFigure]]:
    along = _directions(slide.headings)
    clock = bench.clock(slide.frame, slide.duration)
    motion = bench.motion(*slide.make(slide.ground, clock, velocity=slide.speed * along))
    found = []
    slid = sliding(motion, along, slide.window)
    for heading, back, aside in zip(slide.headings, *slid, strict=True):
        note = "it hops off the ground" if np.isnan(back) else ""
        for name, unit, value in (
            ("sliding friction", "1", back),
            ("friction aside of the slip", "°", aside),
        ):
            name = f"{slide.what}: {name}"
            found.append(bench.measured(name, unit, value, motion, {"heading_deg": heading}, note))
    return motion, found


def _pushed_crate(bench: ContactBench, heading: float) -> list[ContactFigure]:
    """Push below and above what friction bears."""
    (along,) = _directions((heading,))
    shares = np.array(PUSHES)
    push = shares[:, None] * FRICTION * CRATE_MASS * PULL * along
    motion = bench.motion(*crate(_CRATE_GROUND, bench.clock(_FRAME, _PUSHED), force=push))
    way = (motion.position[:, :, 0] - motion.position[:, :1, 0]) @ along
    begin = int(np.searchsorted(motion.time, _CREEPS_FROM - 1e-9))
    creep = (way[:, -1] - way[:, begin]) / (motion.time[-1] - motion.time[begin])
    slides = creep > _SLIDES * FRICTION * PULL * motion.time[-1]
    starts = float(shares[slides][0]) if slides.any() else None
    held, note = creep[PUSHES.index(_HELD)], "" if slides.any() else f"still at {PUSHES[-1]:g}"
    name, at = f"crate: creep at {_HELD:g} of the limit", {"heading_deg": heading}
    return [
        bench.measured(name, "m/s", held, motion, at),
        bench.measured("crate: push that starts it", "1", starts, motion, at, note),
    ]


def _directions(headings: tuple[float, ...]) -> Array:
    angle = np.radians(headings)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
