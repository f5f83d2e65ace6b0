"""Friction that engines deliver: its size and direction on sliding bodies, and on standing ones.

The coefficient is the horizontal impulse over the vertical one, which also holds for a body that
hops. Drag of a profile counts as friction, since both slow a sliding body alike.
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
    PULL,
    ContactBench,
    ContactFigure,
    ball,
    crate,
    wheel,
)
from mbds_xsim.testing.contact_cases import FRICTION, RADIUS, RESTITUTION

_BALL_GROUND = Ground(FRICTION, RESTITUTION)
# With rebound, the corners would push each other and rattle.
_CRATE_GROUND = Ground(FRICTION, 0.0)
HEADINGS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)
"""Angles of the slip from the x axis [°]."""
_CRATE_HEADINGS = (0.0, 45.0)
PUSHES = (0.6, 0.7, 0.8, 0.9, 1.05, 1.2, 1.4, 1.5)
"""Constant forces over the largest that friction can hold, from small to large."""
_PUSH = 0.9
_SLIDES = 0.02  # a body that accelerates by more than this share of μ g slides
_PUSH_TIME = 0.4  # duration of the push [s]
_CREEPS_FROM = 0.2  # settling at the start is over by then [s]
_FRAME = 0.02
_LEAST_LOAD = 0.05  # least part of the weight that the ground must carry


class Slide(NamedTuple):
    """A sliding test: body, ground, headings, speed and times."""

    what: str
    make: Callable[..., tuple[Scene, Batch]]
    ground: Ground
    headings: tuple[float, ...]
    speed: float
    frame: float
    window: tuple[float, float]
    """Start and end of a span in which the body always slides [s]."""
    duration: float


# It slides for 0.339 s, or 0.240 s where the friction cone is a box.
_BALL = Slide("ball", ball, _BALL_GROUND, HEADINGS, 5.0, _FRAME, (0.06, 0.22), 0.38)
# Fast enough that friction does not turn the slip, and short enough that the wheel does not turn
# aside: that it resists a push more along one axis must not affect the direction of friction.
_WHEEL = Slide("wheel", wheel, _BALL_GROUND, HEADINGS, 20.0, 0.005, (0.005, 0.02), 0.02)
# It slides for 0.474 s, or 0.335 s where the friction cone is a box.
_CRATE = Slide("crate", crate, _CRATE_GROUND, _CRATE_HEADINGS, 2.0, _FRAME, (0.1, 0.3), 0.3)


def friction(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure friction on a sliding ball, wheel and crate, and creep and start of a pushed one."""
    on_balls, on_points = (ContactBench(engine, profile, s) for s in ("ballscroll", "simplecubli"))
    motion, figures = _slide_figures(on_balls, _BALL)
    hop = np.nanmax(motion.position[:, :, 0, 2] - RADIUS)
    return [
        *figures,
        on_balls.figure("ball: hops while it slides", "m", hop, motion),
        *_slide_figures(ContactBench(engine, profile, "particlecar"), _WHEEL)[1],
        *_slide_figures(on_points, _CRATE)[1],
        *(m for heading in _CRATE_HEADINGS for m in _push_crate(on_points, heading)),
    ]


def sliding(motion: Trajectory, along: Array, window: tuple[float, float]) -> tuple[Array, Array]:
    """Compute the coefficient of friction, and its angle to the slip [°], each (row,).

    Args:
        motion: Motion of one body.
        along: Direction of the slip at the start, shape (row, 3).
        window: Start and end of a span in which the body always slides [s].

    Returns:
        Coefficient and angle; NaN where the ground does not carry the body.
    """
    begin, end = np.searchsorted(motion.time, np.array(window) - 1e-9)
    change = motion.velocity[:, end, 0] - motion.velocity[:, begin, 0]
    lift = change[:, 2] + PULL * (motion.time[end] - motion.time[begin])
    # A body that has hopped off shows no friction.
    carried = lift > _LEAST_LOAD * PULL * (motion.time[end] - motion.time[begin])
    back = np.where(carried, -np.sum(change * along, axis=1), np.nan)
    aside = np.abs(np.cross(along, change)[:, 2])
    return back / lift, np.degrees(np.arctan2(aside, back))


def _slide_figures(bench: ContactBench, slide: Slide) -> tuple[Trajectory, list[ContactFigure]]:
    along = _directions(slide.headings)
    clock = bench.clock(slide.frame, slide.duration)
    motion = bench.motion(*slide.make(slide.ground, clock, velocity=slide.speed * along))
    figures = []
    results = sliding(motion, along, slide.window)
    for heading, coefficient, angle in zip(slide.headings, *results, strict=True):
        note = "it hops off the ground" if np.isnan(coefficient) else ""
        for name, unit, value in (
            ("sliding friction", "1", coefficient),
            ("friction aside of the slip", "°", angle),
        ):
            name = f"{slide.what}: {name}"
            figures.append(bench.figure(name, unit, value, motion, {"heading_deg": heading}, note))
    return motion, figures


def _push_crate(bench: ContactBench, heading: float) -> list[ContactFigure]:
    """Push a crate with forces below and above the limit of friction."""
    (along,) = _directions((heading,))
    shares = np.array(PUSHES)
    push = shares[:, None] * FRICTION * CRATE_MASS * PULL * along
    motion = bench.motion(*crate(_CRATE_GROUND, bench.clock(_FRAME, _PUSH_TIME), force=push))
    distance = (motion.position[:, :, 0] - motion.position[:, :1, 0]) @ along
    begin = int(np.searchsorted(motion.time, _CREEPS_FROM - 1e-9))
    creep = (distance[:, -1] - distance[:, begin]) / (motion.time[-1] - motion.time[begin])
    slides = creep > _SLIDES * FRICTION * PULL * motion.time[-1]
    onset = float(shares[slides][0]) if slides.any() else None
    rate, note = creep[PUSHES.index(_PUSH)], "" if slides.any() else f"still at {PUSHES[-1]:g}"
    name, at = f"crate: creep at {_PUSH:g} of the limit", {"heading_deg": heading}
    return [
        bench.figure(name, "m/s", rate, motion, at),
        bench.figure("crate: push that starts it", "1", onset, motion, at, note),
    ]


def _directions(headings: tuple[float, ...]) -> Array:
    angle = np.radians(headings)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
