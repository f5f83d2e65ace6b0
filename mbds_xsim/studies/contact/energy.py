"""What becomes of energy in impacts, and how still bodies lie in the end."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.finding import Record, spheres_of
from mbds_xsim.checks.ground import pushes_of
from mbds_xsim.checks.impacts import impacts_of
from mbds_xsim.checks.passivity import energy_rise, passivity
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Ground, Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.studies.contact.bench import (
    FRICTION,
    PULL,
    RADIUS,
    UP,
    ContactBench,
    ContactFigure,
    ball,
    crate,
)

_HEIGHTS = (0.05, 0.06, 0.07)  # of an elastic ball's drops: flights of 0.2 s and more [m]
_BOUNCING = 3.0  # [s]
_FRAME = 0.01
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
    clock = bench.clock(_FRAME, _BOUNCING)
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
    hits = [impacts_of(record, push) for push in pushes_of(record)]
    ratio = np.concatenate([(h.leaving / h.arriving)[h.arriving > _FAST] for h in hits])
    alone = "" if len(ratio) else "no corner hits once and alone between two frames in flight"
    return [
        bench.measured("cubli: energy that no law explains", "1", unexplained.figure.max(), motion),
        bench.measured("cubli: largest rise of energy", "1", whole.figure.max(), motion),
        bench.measured("cubli: restitution of corners", "1", ratio, motion, note=alone),
    ]


_GROUND = Ground(FRICTION, 0.5)
_HEIGHT = 0.05  # dropped from here, a ball of e = 0.5 is at rest after 0.3 s [m]
_FROM, _LONG = 1.0, 0.2  # when it is looked at, and for how long [s]
_STARTS = ("placed", "dropped")


def rest(engine: str, profile: Profile) -> list[ContactFigure]:
    """Measure a ball and a crate after 1 s, placed on the ground and dropped onto it."""
    start = np.outer([0.0, _HEIGHT], UP)
    found: list[ContactFigure] = []
    for what, make, like in (("ball", ball, "balldrop"), ("crate", crate, "simplecubli")):
        bench = ContactBench(engine, profile, like)
        scene, batch = make(_GROUND, bench.clock(_FRAME, _FROM + _LONG), position=start)
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
        for row, start in enumerate(_STARTS)
        for name, unit, values in (*figures, ("moves at", "m/s", speed))
    ]
