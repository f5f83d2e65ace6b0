"""Impacts: what they give back, what becomes of energy, and up to which speeds engines hold.

A ball falls onto the ground at a known speed. Both flights are parabolas, so the restitution and
the time between touch and take-off follow from frames outside of the impact, be it a single
impulse or a spring's. Starts differ in where within a step the ball touches, and none does so just
at the end of one.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.ground import impacts_of, pushes_of
from mbds_xsim.checks.passivity import energy_rise, passivity
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.spheres import spheres_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Ground, Inertia, Joint, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.studies.contact import (
    FRICTION,
    PULL,
    RADIUS,
    RESTITUTION,
    UP,
    ContactBench,
    ContactFigure,
    ball,
    crate,
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


# What becomes of energy in impacts, and how still bodies lie in the end.

_HEIGHTS = (0.05, 0.06, 0.07)  # of an elastic ball's drops: flights of 0.2 s and more [m]
_BOUNCING = 3.0  # [s]
_ENERGY_FRAME = 0.01
_STOPPED = 1e-3  # of the drop's energy
_CUBLI = "simplecubli"
_CUBLIS, _CUBLI_STEPS = 3, 75
_FAST = 0.5  # slower impacts have too much of gravity in them [m/s]


def energy(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure an elastic ball's change by bounce, and what a thrown cubli gains."""
    return [
        _elastic(ContactBench(engine, profile, "balldrop")),
        *_eccentric(ContactBench(engine, profile, _CUBLI)),
    ]


def _elastic(bench: ContactBench) -> ContactFigure:
    clock = bench.clock(_ENERGY_FRAME, _BOUNCING)
    motion = bench.motion(*ball(Ground(FRICTION, 1.0), clock, position=np.outer(_HEIGHTS, UP)))
    gap = motion.position[:, :, 0, 2] - RADIUS
    climb = motion.velocity[:, :, 0, 2] + PULL * bench.lag
    change = [per_bounce(g, c, h) for g, c, h in zip(gap, climb, _HEIGHTS, strict=True)]
    return bench.measured("elastic ball: energy by bounce", "1", np.array(change), motion)


def per_bounce(gap: Array, climb: Array, height: float) -> float:
    """Give the mean relative change of energy in a bounce, −1 where none comes back.

    Args:
        gap: Of the ball's lowest point [m], shape (frame,).
        climb: Its vertical speed [m/s], shape (frame,).
        height: It was dropped from [m].
    """
    top = np.where(gap > 0.0, gap + climb**2 / (2 * PULL), np.nan)
    turned = (climb[1:] > 0.0) & (climb[:-1] < 0.0)
    flight = np.concatenate([[0], np.cumsum(turned)])
    tops = [_median(top[flight == k]) for k in range(int(flight[-1]) + 1)]
    whole = [value for value in tops if value > _STOPPED * height]
    if len(whole) < 2 or not np.isfinite(gap).all():
        return -1.0 if np.isfinite(gap).all() else np.nan
    return float((whole[-1] / height) ** (1.0 / (len(whole) - 1)) - 1.0)


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


def _eccentric(bench: ContactBench) -> list[ContactFigure]:
    """Throw cublis: one corner at a time hits, beside the centre of mass."""
    scene = load_scene(_CUBLI)
    batch = draw_batch(scene, range(_CUBLIS), noise=False, inputs=False).truncated(_CUBLI_STEPS)
    motion = bench.motion(scene, batch)
    settings = bench.settings
    method = load_adapter(bench.engine).methods[settings.method]
    record = Record(scene, batch, motion, method, settings.step)
    unexplained, whole = passivity(record), energy_rise(record)
    assert unexplained is not None
    assert whole is not None
    begun = bool(np.isfinite(motion.position).any())
    gained, rise = (float(each.figure.max()) if begun else None for each in (unexplained, whole))
    hits = [impacts_of(record, push) for push in pushes_of(record)]
    ratio = np.concatenate([(h.leaving / h.arriving)[h.arriving > _FAST] for h in hits])
    alone = "" if len(ratio) else "no corner hits once and alone between two frames in flight"
    return [
        bench.measured("cubli: energy that no law explains", "1", gained, motion),
        bench.measured("cubli: largest rise of energy", "1", rise, motion),
        bench.measured("cubli: restitution of corners", "1", ratio, motion, note=alone),
    ]


_LIVELY = Ground(FRICTION, 0.5)
_HEIGHT = 0.05  # dropped from here, a ball of e = 0.5 is at rest after 0.3 s [m]
_FROM, _LONG = 1.0, 0.2  # when it is looked at, and for how long [s]
_WAYS = ("placed", "dropped")


def rest(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure a ball and a crate after 1 s, placed on the ground and dropped onto it."""
    start = np.outer([0.0, _HEIGHT], UP)
    found: list[ContactFigure] = []
    for what, make, like in (("ball", ball, "balldrop"), ("crate", crate, "simplecubli")):
        bench = ContactBench(engine, profile, like)
        scene, batch = make(_LIVELY, bench.clock(_ENERGY_FRAME, _FROM + _LONG), position=start)
        found += _stillness(bench, what, scene, bench.motion(scene, batch))
    return found


def _stillness(
    bench: ContactBench, what: str, scene: Scene, motion: Trajectory
) -> list[ContactFigure]:
    """Look at the lowest sphere and at the centre of mass."""
    mechanism, late = Mechanism.of(scene), motion.time >= _FROM - 1e-9
    native = mechanism.native_rotation(motion.orientation)
    states = BodyStates(motion.position, native, motion.velocity, motion.angular_velocity)
    lowest = spheres_of(mechanism, states).gap[:, late].min(axis=2)
    speed = np.linalg.norm(motion.velocity[:, late, 0], axis=-1).max(axis=1)
    figures = (("sinks by", "m", -lowest.min(axis=1)), ("hops by", "m", np.ptp(lowest, axis=1)))
    return [
        bench.measured(f"{what} {start}: {name}", unit, values[row], motion)
        for row, start in enumerate(_WAYS)
        for name, unit, values in (*figures, ("moves at", "m/s", speed))
    ]


# How fast things may move before an engine delivers something else, and whether it says so.

SPINS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
"""[rad/s]"""
DROPS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
"""Speeds of impacts [m/s]."""
_BOUNCY = Ground(FRICTION, RESTITUTION)
_AXIS = np.array([0.0, 1.0, 0.0])
_LIMIT_DURATION = 0.1  # [s]
_LIMIT_FRAME = 0.02
_WRONG = 0.01  # relative
_FALL = 0.01  # to the ground [s]


def limits(engine: str, profile: Profile) -> list[ContactFigure]:
    """Find the fastest spin of a free ball and of a hinged wheel, and the fastest impact."""
    free, hinged = (ContactBench(engine, profile, like) for like in ("balldrop", "particlecar"))
    return [
        _spinning(free, "free spin", *_flying(free)),
        _spinning(hinged, "hinge spin", *_hinged(hinged)),
        _falling(free),
    ]


def _flying(bench: ContactBench) -> tuple[Scene, Batch]:
    position, spin = np.tile(UP, (len(SPINS), 1)), np.outer(SPINS, _AXIS)
    clock = bench.clock(_LIMIT_FRAME, _LIMIT_DURATION)
    return ball(_BOUNCY, clock, position=position, angular_velocity=spin)


def _hinged(bench: ContactBench) -> tuple[Scene, Batch]:
    """Make a wheel on an axle that stands still."""
    wheel = Body("wheel", inertia=Inertia(1.0, (0.01, 0.02, 0.01)), position=(0.0, 0.0, 1.0))
    axle = Joint("axle", "hinge", "world", "wheel", anchor=(0.0, 0.0, 1.0), axis=(0.0, 1.0, 0.0))
    clock = bench.clock(_LIMIT_FRAME, _LIMIT_DURATION)
    scene = Scene("wheel", (wheel,), length=1.0, joints=(axle,), clock=clock)
    batch = draw_batch(scene, range(len(SPINS)))
    return scene, dataclasses.replace(batch, angular_velocity=np.outer(SPINS, _AXIS)[:, None])


def _spinning(bench: ContactBench, quantity: str, scene: Scene, batch: Batch) -> ContactFigure:
    """Hold rates against the start's, and turns against rate times time."""
    motion = bench.motion(scene, batch)
    angle = batch.angular_velocity[:, 0] @ _AXIS
    wanted = rotation.from_vector((angle[:, None] * motion.time)[..., None] * _AXIS)
    error = rotation.multiply(rotation.conjugate(wanted), motion.orientation[:, :, 0])
    turned = np.linalg.norm(rotation.to_vector(error), axis=-1)
    rate = motion.angular_velocity[:, :, 0] @ _AXIS
    right = np.abs(rate - angle[:, None]) <= _WRONG * angle[:, None]
    # A turn of a frame that is 1 % short shows at every speed, though whole turns do not.
    right &= turned <= _WRONG * angle[:, None] * np.maximum(motion.time, motion.time[1])
    whole = np.logical_and.reduce(right, axis=1)
    return _highest(bench, quantity, "rad/s", SPINS, whole, rate[:, -1], motion)


def _falling(bench: ContactBench) -> ContactFigure:
    """Ask whether the ground still holds: it is not whether the rebound is right."""
    start, clock = np.outer(DROPS, UP), bench.clock(_LIMIT_FRAME, _LIMIT_DURATION)
    motion = bench.motion(*ball(_BOUNCY, clock, position=_FALL * start, velocity=-start))
    height = motion.position[:, :, 0, 2]
    held = np.logical_and.reduce(height > 0.0, axis=1)
    return _highest(bench, "impact speed held", "m/s", DROPS, held, height[:, -1] - RADIUS, motion)


def _highest(
    bench: ContactBench,
    quantity: str,
    unit: str,
    asked: tuple[float, ...],
    right: Mask,
    got: Array,
    motion: Trajectory,
) -> ContactFigure:
    """Give the last that is right, with what the engine does, or says, beyond."""
    failed = np.array([failure is not None for failure in motion.failures])
    beyond = np.flatnonzero(failed | ~right)
    first = int(beyond[0]) if len(beyond) else len(asked)
    note = f"all up to {asked[-1]:g} {unit} delivered"
    if first < len(asked):
        failure = motion.failures[first]
        silent = f"silent at {asked[first]:g} {unit}: {got[first]:.4g}"
        note = silent if failure is None else f"told at {asked[first]:g} {unit}: {failure.reason}"
    reached = asked[first - 1] if first else None
    return ContactFigure(bench.engine, bench.profile, quantity, unit, reached, note=note)
