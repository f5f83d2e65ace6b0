"""What an impact gives back, how long it takes and how deep it goes.

A ball falls onto the ground at a known speed. Both flights are parabolas, so the restitution and
the time between touch and take-off follow from frames outside of the impact, be it a single
impulse or a spring's. Starts differ in where within a step the ball touches, and none does so just
at the end of one.
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Ground
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.studies.contact.bench import (
    FRICTION,
    PULL,
    RADIUS,
    RESTITUTION,
    UP,
    ContactBench,
    ContactFigure,
    ball,
)

RESTITUTIONS = (0.0, 0.5, RESTITUTION, 1.0)
SPEEDS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
DEPTH_SPEEDS = (1.0, 5.0)
_STARTS = 8
_BEFORE = 1e-3  # the shortest fall to the ground [s]
_DURATION = 0.04  # within which the ball must have left the ground [s]
_FRAME = 1e-3
_LEAST = 0.02  # of the impact's speed: what comes back slower is at rest
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
# Times from touch to frame [s] and how many: together they sample impacts of any duration.
_SHORTEST, _SAMPLES = 2e-6, 96


def impacts(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure restitution, duration and depth of a ball's impacts."""
    bench = ContactBench(engine, profile, "balldrop")
    found = [m for e in RESTITUTIONS for v in SPEEDS for m in _rebound(bench, e, v)]
    return found + [_depth(bench, speed) for speed in DEPTH_SPEEDS]


def rebounds(
    bench: ContactBench, restitution: float, speed: float
) -> tuple[Array, Array, Trajectory]:
    """Give restitution and duration of impacts that begin at other phases of a step, (row,)."""
    fall = _BEFORE + bench.settings.step * np.mod(_GOLDEN * np.arange(1, _STARTS + 1), 1.0)
    motion = _dropped(bench, restitution, speed, fall)
    gap, raw = _height(motion)
    climb = raw + PULL * bench.lag  # at the frame's time, in flight
    moves = gap + raw**2 / (2 * PULL) > (_LEAST * speed) ** 2 / (2 * PULL)
    flying = (motion.time > fall[:, None]) & (gap > 0.0) & moves
    first, row = flying.argmax(axis=1), np.arange(_STARTS)
    gone = climb[row, first] ** 2 + 2 * PULL * gap[row, first]
    off = motion.time[first] - (np.sqrt(gone) - climb[row, first]) / PULL
    lost = np.isnan(gap).any(axis=1)
    kept = np.where(flying.any(axis=1), np.sqrt(gone) / speed, np.where(lost, np.nan, 0.0))
    return kept, np.where(flying.any(axis=1), off - fall, np.nan), motion


def _rebound(bench: ContactBench, restitution: float, speed: float) -> list[ContactFigure]:
    kept, duration, motion = rebounds(bench, restitution, speed)
    at, note = {"restitution": restitution, "speed": speed}, "does not come back"
    return [
        bench.measured("restitution", "1", kept, motion, at),
        bench.measured("impact duration", "s", duration, motion, at, note),
    ]


def _depth(bench: ContactBench, speed: float) -> ContactFigure:
    """Look at the ball at many times after the touch; the deepest place is what counts."""
    clock = bench.clock(_FRAME, _DURATION)
    fall = 2 * clock.frame - np.geomspace(_SHORTEST, clock.frame, _SAMPLES)
    motion = _dropped(bench, RESTITUTION, speed, fall)
    deepest = np.nanmax(-_height(motion)[0]) if np.isfinite(motion.position).any() else None
    at = {"restitution": RESTITUTION, "speed": speed}
    return bench.measured("impact depth", "m", deepest, motion, at)


def _dropped(bench: ContactBench, restitution: float, speed: float, fall: Array) -> Trajectory:
    """Let a ball arrive at a speed [m/s] after falls of some times [s], shape (row,)."""
    position = speed * fall - 0.5 * PULL * fall**2
    # As the method records it, so that the ball arrives as it should.
    velocity = PULL * fall - speed - PULL * bench.lag
    ground, clock = Ground(FRICTION, restitution), bench.clock(_FRAME, _DURATION)
    start = {"position": np.outer(position, UP), "velocity": np.outer(velocity, UP)}
    return bench.motion(*ball(ground, clock, **start))


def _height(motion: Trajectory) -> tuple[Array, Array]:
    """Height of the lowest point [m] and vertical speed [m/s], shape (row, frame)."""
    return motion.position[:, :, 0, 2] - RADIUS, motion.velocity[:, :, 0, 2]
