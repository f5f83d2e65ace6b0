"""Friction that engines deliver: on what slides, in which direction, and on what should stand.

The coefficient is the horizontal impulse over the vertical one, so that a body that hops shows it
in its hop. Drag that a profile has counts as friction: what slides knows no difference.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.scene.scene import Ground
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.studies.contact.bench import (
    CRATE_MASS,
    FRICTION,
    PULL,
    RADIUS,
    RESTITUTION,
    ContactBench,
    ContactFigure,
    ball,
    crate,
    reason,
    wheel,
)

Array = NDArray[np.float64]

_BALL_GROUND = Ground(FRICTION, RESTITUTION)
# Corners that rebound from each other's pushes would rattle.
_CRATE_GROUND = Ground(FRICTION, 0.0)
HEADINGS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)
"""Of the slip from the x axis [°]."""
_CRATE_HEADINGS = (0.0, 45.0)
_BALL_SPEED, _BALL_WINDOW = 5.0, (0.06, 0.22)  # it slides for 0.339 s, and 0.240 s in a box
# So fast that friction does not turn the slip, and so short that the wheel does not turn aside.
_WHEEL_SPEED, _WHEEL_WINDOW, _WHEEL_FRAME = 20.0, (0.005, 0.02), 0.005
_CRATE_SPEED, _CRATE_WINDOW = 2.0, (0.1, 0.3)  # it slides for 0.474 s, and 0.335 s in a box
PUSHES = (0.6, 0.7, 0.8, 0.9, 1.05, 1.2, 1.4, 1.5)
"""Held forces over the largest that friction bears, from small to large."""
_HELD = 0.9
_SLIDES = 0.02  # what a push so much above the limit makes it faster by is no creep
_PUSHED = 0.4  # [s]
_CREEPS_FROM = 0.2  # what sets itself at the start is over by then [s]
_FRAME = 0.02
_CARRIED = 0.05  # of the weight


def friction(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure friction on a sliding ball, wheel and crate; a pushed crate's creep and start."""
    on_points = ContactBench(engine, profile, "simplecubli")
    return [
        *_sliding_ball(ContactBench(engine, profile, "ballscroll")),
        *_sliding_wheel(ContactBench(engine, profile, "particlecar")),
        *_sliding_crate(on_points),
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


def _sliding_ball(bench: ContactBench) -> list[ContactFigure]:
    along = _directions(HEADINGS)
    clock = bench.clock(_FRAME, 2 * _BALL_WINDOW[1] - _BALL_WINDOW[0])
    motion = bench.motion(*ball(_BALL_GROUND, clock, velocity=_BALL_SPEED * along))
    hop = np.nanmax(motion.position[:, :, 0, 2] - RADIUS)
    return [
        *_by_heading(bench, "ball", HEADINGS, *sliding(motion, along, _BALL_WINDOW), motion),
        bench.measured("ball: hops while it slides", "m", hop, {}, reason(motion)),
    ]


def _sliding_wheel(bench: ContactBench) -> list[ContactFigure]:
    """What is harder to move along one axis than along the other: friction must not care."""
    along = _directions(HEADINGS)
    clock = bench.clock(_WHEEL_FRAME, _WHEEL_WINDOW[1])
    motion = bench.motion(*wheel(_BALL_GROUND, clock, velocity=_WHEEL_SPEED * along))
    found = sliding(motion, along, _WHEEL_WINDOW)
    return _by_heading(bench, "wheel", HEADINGS, *found, motion)


def _sliding_crate(bench: ContactBench) -> list[ContactFigure]:
    along = _directions(_CRATE_HEADINGS)
    clock = bench.clock(_FRAME, _CRATE_WINDOW[1])
    motion = bench.motion(*crate(_CRATE_GROUND, clock, velocity=_CRATE_SPEED * along))
    found = sliding(motion, along, _CRATE_WINDOW)
    return _by_heading(bench, "crate", _CRATE_HEADINGS, *found, motion)


def _by_heading(
    bench: ContactBench,
    what: str,
    headings: tuple[float, ...],
    back: Array,
    aside: Array,
    motion: Trajectory,
) -> list[ContactFigure]:
    found = []
    for heading, coefficient, angle in zip(headings, back, aside, strict=True):
        at = {"heading_deg": heading}
        note = reason(motion) or ("it hops off the ground" if np.isnan(coefficient) else "")
        found += [
            bench.measured(f"{what}: sliding friction", "1", coefficient, at, note),
            bench.measured(f"{what}: friction aside of the slip", "°", angle, at, note),
        ]
    return found


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
    at, note = {"heading_deg": heading}, reason(motion)
    still = "" if slides.any() else note or f"still at {PUSHES[-1]:g}"
    held = creep[PUSHES.index(_HELD)]
    return [
        bench.measured(f"crate: creep at {_HELD:g} of the limit", "m/s", held, at, note),
        bench.measured("crate: push that starts it", "1", starts, at, still),
    ]


def _directions(headings: tuple[float, ...]) -> Array:
    angle = np.radians(headings)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
