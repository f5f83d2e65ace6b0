"""Impacts: restitution, energy, rest afterwards, and the speeds up to which engines are right.

A ball falls onto the ground at a known speed. Both flights are parabolas, so the restitution and
the time from touch to take-off follow from frames outside of the impact, whether it is a single
impulse or the push of a spring. Starts differ in the phase of the step at which the ball touches;
none touches exactly at the end of a step.
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
from mbds_xsim.studies.contact import PULL, UP, ContactBench, ContactFigure, ball, crate
from mbds_xsim.testing.contact_cases import FRICTION, RADIUS, RESTITUTION, RESTITUTIONS

SPEEDS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
DEPTH_SPEEDS = (1.0, 5.0)
_STARTS = 8
_BEFORE = 1e-3  # the shortest fall to the ground [s]
_DURATION = 0.04  # time by which the ball must be off the ground again [s]
_FRAME = 1e-3
_LEAST = 0.02  # part of the impact's speed: a ball that returns slower is at rest
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
# Shortest time from touch to frame [s], and number of times: they sample impacts of any duration.
_SHORTEST, _SAMPLES = 2e-6, 96


def impacts(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure restitution, duration and depth of a ball's impacts."""
    bench = ContactBench(engine, profile, "balldrop")
    figures = [m for e in RESTITUTIONS for v in SPEEDS for m in _rebound(bench, e, v)]
    return figures + [_depth(bench, speed) for speed in DEPTH_SPEEDS]


def rebounds(
    bench: ContactBench, restitution: float, speed: float
) -> tuple[Array, Array, Trajectory]:
    """Measure restitution and duration [s] of impacts at several phases of a step, each (row,)."""
    fall = _BEFORE + bench.settings.step * np.mod(_GOLDEN * np.arange(1, _STARTS + 1), 1.0)
    motion = _drop(bench, restitution, speed, fall)
    gap, raw = _height(motion)
    climb = raw + PULL * bench.lag  # speed at the frame's time, in flight
    moves = gap + raw**2 / (2 * PULL) > (_LEAST * speed) ** 2 / (2 * PULL)
    flying = (motion.time > fall[:, None]) & (gap > 0.0) & moves
    first, row = flying.argmax(axis=1), np.arange(_STARTS)
    squared = climb[row, first] ** 2 + 2 * PULL * gap[row, first]
    take_off = motion.time[first] - (np.sqrt(squared) - climb[row, first]) / PULL
    lost = np.isnan(gap).any(axis=1)
    ratio = np.where(flying.any(axis=1), np.sqrt(squared) / speed, np.where(lost, np.nan, 0.0))
    return ratio, np.where(flying.any(axis=1), take_off - fall, np.nan), motion


def _rebound(bench: ContactBench, restitution: float, speed: float) -> list[ContactFigure]:
    ratio, duration, motion = rebounds(bench, restitution, speed)
    at, note = {"restitution": restitution, "speed": speed}, "does not come back"
    return [
        bench.figure("restitution", "1", ratio, motion, at),
        bench.figure("impact duration", "s", duration, motion, at, note),
    ]


def _depth(bench: ContactBench, speed: float) -> ContactFigure:
    """Measure the largest depth of a ball, sampled at many times after the touch."""
    clock = bench.clock(_FRAME, _DURATION)
    fall = 2 * clock.frame - np.geomspace(_SHORTEST, clock.frame, _SAMPLES)
    motion = _drop(bench, RESTITUTION, speed, fall)
    deepest = np.nanmax(-_height(motion)[0]) if np.isfinite(motion.position).any() else None
    at = {"restitution": RESTITUTION, "speed": speed}
    return bench.figure("impact depth", "m", deepest, motion, at)


def _drop(bench: ContactBench, restitution: float, speed: float, fall: Array) -> Trajectory:
    """Let a ball hit the ground at a speed [m/s] after falls of given times [s], shape (row,)."""
    position = speed * fall - 0.5 * PULL * fall**2
    # Shifted as the method records it, so that the ball arrives at the right speed.
    velocity = PULL * fall - speed - PULL * bench.lag
    ground, clock = Ground(FRICTION, restitution), bench.clock(_FRAME, _DURATION)
    start = {"position": np.outer(position, UP), "velocity": np.outer(velocity, UP)}
    return bench.motion(*ball(ground, clock, **start))


def _height(motion: Trajectory) -> tuple[Array, Array]:
    """Return height of the lowest point [m] and vertical speed [m/s], shape (row, frame)."""
    return motion.position[:, :, 0, 2] - RADIUS, motion.velocity[:, :, 0, 2]


# Energy in impacts, and how still bodies lie afterwards.

_HEIGHTS = (0.05, 0.06, 0.07)  # drops of an elastic ball, with flights of 0.2 s and more [m]
_BOUNCING = 3.0  # [s]
_ENERGY_FRAME = 0.01
_STOPPED = 1e-3  # part of the drop's energy at which a ball has stopped
_CUBLI = "simplecubli"
_CUBLIS, _CUBLI_STEPS = 3, 75
_FAST = 0.5  # in slower impacts gravity matters too much [m/s]


def energy(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure energy: an elastic ball's change per bounce, and a thrown cubli's gain."""
    return [
        _elastic(ContactBench(engine, profile, "balldrop")),
        *_eccentric(ContactBench(engine, profile, _CUBLI)),
    ]


def _elastic(bench: ContactBench) -> ContactFigure:
    clock = bench.clock(_ENERGY_FRAME, _BOUNCING)
    motion = bench.motion(*ball(Ground(FRICTION, 1.0), clock, position=np.outer(_HEIGHTS, UP)))
    gap, raw = _height(motion)
    climb = raw + PULL * bench.lag
    change = [per_bounce(g, c, h) for g, c, h in zip(gap, climb, _HEIGHTS, strict=True)]
    return bench.figure("elastic ball: energy by bounce", "1", np.array(change), motion)


def per_bounce(gap: Array, climb: Array, height: float) -> float:
    """Return the mean relative change of energy per bounce; −1 if the ball does not come back.

    Args:
        gap: Height of the ball's lowest point [m], shape (frame,).
        climb: Vertical speed of the ball [m/s], shape (frame,).
        height: Height from which the ball was dropped [m].
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
    """Throw cublis so that single corners hit the ground, off the centre of mass."""
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
    note = "" if len(ratio) else "no corner hits once and alone between two frames in flight"
    return [
        bench.figure("cubli: energy that no law explains", "1", gained, motion),
        bench.figure("cubli: largest rise of energy", "1", rise, motion),
        bench.figure("cubli: restitution of corners", "1", ratio, motion, note=note),
    ]


_LIVELY = Ground(FRICTION, 0.5)
_HEIGHT = 0.05  # dropped from here, a ball of e = 0.5 is at rest after 0.3 s [m]
_FROM, _LONG = 1.0, 0.2  # start and duration of the observation [s]
_WAYS = ("placed", "dropped")


def rest(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure how still a ball and a crate lie after 1 s, placed on the ground or dropped."""
    start = np.outer([0.0, _HEIGHT], UP)
    figures: list[ContactFigure] = []
    for body, make, like in (("ball", ball, "balldrop"), ("crate", crate, "simplecubli")):
        bench = ContactBench(engine, profile, like)
        scene, batch = make(_LIVELY, bench.clock(_ENERGY_FRAME, _FROM + _LONG), position=start)
        motion, mechanism = bench.motion(scene, batch), Mechanism.of(scene)
        late = motion.time >= _FROM - 1e-9
        # Depth and hops of the lowest sphere, and the speed of the centre of mass.
        gap = spheres_of(mechanism, BodyStates.of(mechanism, motion)).gap
        lowest = gap[:, late].min(axis=2)
        speed = np.linalg.norm(motion.velocity[:, late, 0], axis=-1).max(axis=1)
        for row, way in enumerate(_WAYS):
            for name, unit, values in (
                ("sinks by", "m", -lowest.min(axis=1)),
                ("hops by", "m", np.ptp(lowest, axis=1)),
                ("moves at", "m/s", speed),
            ):
                figures.append(bench.figure(f"{body} {way}: {name}", unit, values[row], motion))
    return figures


# Speeds up to which an engine is right, and whether it reports a failure beyond.

SPINS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
"""Spins to try [rad/s]."""
DROPS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
"""Impact speeds to try [m/s]."""
_BOUNCY = Ground(FRICTION, RESTITUTION)
_AXIS = np.array([0.0, 1.0, 0.0])
_LIMIT_DURATION = 0.1  # [s]
_LIMIT_FRAME = 0.02
_WRONG = 0.01  # relative error
_FALL = 0.01  # time of the fall to the ground [s]


def limits(engine: str, profile: Profile) -> list[ContactFigure]:
    """Find the fastest correct spin of a free ball and a hinged wheel, and the fastest impact."""
    free, hinged = (ContactBench(engine, profile, like) for like in ("balldrop", "particlecar"))
    return [
        _spinning(free, "free spin", *_flying(free)),
        _spinning(hinged, "hinge spin", *_hinged_wheel(hinged)),
        _falling(free),
    ]


def _flying(bench: ContactBench) -> tuple[Scene, Batch]:
    position, spin = np.tile(UP, (len(SPINS), 1)), np.outer(SPINS, _AXIS)
    clock = bench.clock(_LIMIT_FRAME, _LIMIT_DURATION)
    return ball(_BOUNCY, clock, position=position, angular_velocity=spin)


def _hinged_wheel(bench: ContactBench) -> tuple[Scene, Batch]:
    """Make a wheel on a fixed axle."""
    wheel = Body("wheel", inertia=Inertia(1.0, (0.01, 0.02, 0.01)), position=(0.0, 0.0, 1.0))
    axle = Joint("axle", "hinge", "world", "wheel", anchor=(0.0, 0.0, 1.0), axis=(0.0, 1.0, 0.0))
    clock = bench.clock(_LIMIT_FRAME, _LIMIT_DURATION)
    scene = Scene("wheel", (wheel,), length=1.0, joints=(axle,), clock=clock)
    batch = draw_batch(scene, range(len(SPINS)))
    return scene, dataclasses.replace(batch, angular_velocity=np.outer(SPINS, _AXIS)[:, None])


def _spinning(bench: ContactBench, quantity: str, scene: Scene, batch: Batch) -> ContactFigure:
    """Compare rates with those at the start, and turns with rate times time."""
    motion = bench.motion(scene, batch)
    spin = batch.angular_velocity[:, 0] @ _AXIS
    expected = rotation.from_vector((spin[:, None] * motion.time)[..., None] * _AXIS)
    error = rotation.multiply(rotation.conjugate(expected), motion.orientation[:, :, 0])
    deviation = np.linalg.norm(rotation.to_vector(error), axis=-1)
    rate = motion.angular_velocity[:, :, 0] @ _AXIS
    right = np.abs(rate - spin[:, None]) <= _WRONG * spin[:, None]
    # A turn 1 % short in one frame shows at every speed, although missing whole turns do not.
    right &= deviation <= _WRONG * spin[:, None] * np.maximum(motion.time, motion.time[1])
    correct = np.logical_and.reduce(right, axis=1)
    return _highest(bench, quantity, "rad/s", SPINS, correct, rate[:, -1], motion)


def _falling(bench: ContactBench) -> ContactFigure:
    """Find the fastest impact that the ground holds, whether or not the rebound is right."""
    start, clock = np.outer(DROPS, UP), bench.clock(_LIMIT_FRAME, _LIMIT_DURATION)
    motion = bench.motion(*ball(_BOUNCY, clock, position=_FALL * start, velocity=-start))
    height = motion.position[:, :, 0, 2]
    above = np.logical_and.reduce(height > 0.0, axis=1)
    return _highest(bench, "impact speed held", "m/s", DROPS, above, height[:, -1] - RADIUS, motion)


def _highest(
    bench: ContactBench,
    quantity: str,
    unit: str,
    speeds: tuple[float, ...],
    right: Mask,
    delivered: Array,
    motion: Trajectory,
) -> ContactFigure:
    """Return the highest correct speed, with a note on what the engine does beyond it."""
    reached: float | None = None
    note = f"all up to {speeds[-1]:g} {unit} delivered"
    for speed, fine, value, failure in zip(speeds, right, delivered, motion.failures, strict=True):
        if failure is not None or not fine:
            silent = f"silent at {speed:g} {unit}: {value:.4g}"
            note = f"told at {speed:g} {unit}: {failure.reason}" if failure else silent
            break
        reached = speed
    return ContactFigure(bench.engine, bench.profile, quantity, unit, reached, note=note)
