"""Single impacts between two frames in flight, taken apart by the scene's own motion.

The frame before is followed forwards, and the frame after backwards, to where the sphere touches
the ground. What lies between the two states is the impact: its impulse is the one that the
momentum of the frames shows.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.checks.finding import Figures, Record, Spheres, check, spheres_of
from mbds_xsim.checks.ground import Push, balls_of
from mbds_xsim.scene.joint_space import BodyStates

_REFINEMENTS = 4  # Newton's steps to the time of touch
_SUBSTEPS = 4  # of Runge and Kutta to it
_APART = 0.5  # of the flight that follows a rebound: a step with so much time left has two impacts
_SLOW = 3.0  # times what gravity adds in a frame: slower impacts are no measure of restitution


@dataclass(frozen=True, eq=False)
class Impacts:
    """Impacts of one sphere each, one entry an impact."""

    row: Index
    step: Index
    sphere: Index
    before: BodyStates
    """At the touch on arrival, shape (impact, body, …)."""
    after: BodyStates
    """At the touch on leaving."""
    arriving: Array
    """Downward speed of the sphere [m/s]."""
    leaving: Array
    """Upward speed [m/s]."""
    slip: Array
    """Horizontal velocity of the sphere's lowest point on arrival [m/s], shape (impact, 2)."""
    rebound: Array
    """The same on leaving."""
    duration: Array
    """From arrival to leaving, negative where the motions meet above the ground [s]."""
    impulse: Array
    """Of the ground [N·s], shape (impact, 3)."""
    gap: Array
    """Between sphere and ground where the two motions meet, negative below it [m]."""

    def __getitem__(self, picks: Mask) -> Impacts:
        """Take some of the impacts."""
        return Impacts(**{key: value[picks] for key, value in vars(self).items()})


@check("restitution", "restitution")
def restitution(record: Record) -> Figures | None:
    """Compare the delivered with the scene's coefficient of restitution; None without balls.

    Only for spheres around centres of mass, whose rebound nothing else has a part in.
    """
    pushes = balls_of(record)
    if not pushes:
        return None
    wanted = record.ground.restitution
    found = [fast_impacts_of(record, push) for push in pushes]
    ratios = [hits.leaving / hits.arriving for hits in found]
    off = [(hits, np.abs(ratio - wanted)) for hits, ratio in zip(found, ratios, strict=True)]
    note = told_restitution(np.concatenate(ratios).tolist(), wanted)
    return Figures(at_impacts(record, off), [push.name for push in pushes], note)


def at_impacts(record: Record, groups: list[tuple[Impacts, Array]]) -> Array:
    """Put values of impacts at the frames after them, (trajectory, frame, group)."""
    parts = np.full((*record.finite.shape, len(groups)), np.nan)
    parts[:, 0] = 0.0  # not every trajectory bounces
    for k, (hits, values) in enumerate(groups):
        parts[hits.row, hits.step + 1, k] = values
    return parts


def told_restitution(ratios: list[float], wanted: float) -> str:
    """Say which coefficients were delivered."""
    if not ratios:
        return f"no impact, the scene has {wanted:.4f}"
    told = f"{min(ratios):.4f} to {max(ratios):.4f} delivered, median {np.median(ratios):.4f}"
    return f"{told}, the scene has {wanted:.4f}"


@functools.lru_cache(maxsize=4)
def fast_impacts_of(record: Record, push: Push) -> Impacts:
    """Find the single impacts that are a measure of restitution."""
    hits = impacts_of(record, push)
    return hits[hits.arriving > _SLOW * record.fall]


@functools.lru_cache(maxsize=4)
def impacts_of(record: Record, push: Push) -> Impacts:
    """Find the steps in which one sphere, and no other of its group, hits the ground once."""
    free = push.untouched
    alone = push.reach.sum(axis=2) == 1
    row, step = np.nonzero(free[:, 1:] & free[:, :-1] & alone & (push.impulse[..., 2] > 0.0))
    sphere = push.spheres[push.reach[row, step].argmax(axis=1)]
    arrival, before, falling = _at_touch(record, row, step, step, sphere)
    parting, after, rising = _at_touch(record, row, step, step + 1, sphere)
    pull = record.pull or np.finfo(float).tiny
    left = record.frame - falling + rising
    arriving, leaving = -before.climb, after.climb
    single = (arriving > 0.0) & (leaving > 0.0) & (falling >= 0.0) & (rising <= 0.0)
    single &= left < np.maximum(_APART * 2.0 * leaving / pull, 0.1 * record.frame)
    return Impacts(
        row=row[single],
        step=step[single],
        sphere=sphere[single],
        before=arrival[single],
        after=parting[single],
        arriving=arriving[single],
        leaving=leaving[single],
        slip=before.slip[single],
        rebound=after.slip[single],
        duration=left[single],
        impulse=push.impulse[row, step][single],
        gap=(-left / (1.0 / arriving + 1.0 / leaving))[single],
    )


def _at_touch(
    record: Record, row: Index, step: Index, frame: Index, sphere: Index
) -> tuple[BodyStates, Spheres, Array]:
    """Follow frames to the touch of a sphere: bodies and sphere there, and the time to it [s].

    Forwards from the step's first frame, backwards from its last; NaN where it stays clear.
    """
    bodies = record.bodies[row, frame]
    force, torque = record.batch.force[row, step], record.batch.torque[row, step]
    sense = np.where(frame > step, -1.0, 1.0)
    time, limit = np.zeros(len(row)), 1.5 * record.frame
    there, here = bodies, one_sphere(record, bodies, sphere)
    for k in range(_REFINEMENTS + 1):
        speed = sense * here.climb
        # The first guess is a parabola's, on which Newton's steps cannot go astray.
        square = np.sqrt(speed**2 + 2.0 * record.pull * np.maximum(here.gap, 0.0))
        ahead = 2.0 * here.gap / (square - speed) if k == 0 else -here.gap / speed
        time = np.clip(time + sense * ahead, -limit, limit)
        there = followed(record, bodies, force, torque, time)
        here = one_sphere(record, there, sphere)
    reached = (np.abs(time) <= record.frame) & (np.abs(here.gap) < 1e-6 * record.scene.length)
    return there, here, np.where(reached, time, np.nan)


def one_sphere(record: Record, bodies: BodyStates, sphere: Index) -> Spheres:
    """Look at one sphere of each state."""
    spheres, each = spheres_of(record.mechanism, bodies), np.arange(len(sphere))
    return Spheres(*(values[each, sphere] for values in vars(spheres).values()))


def followed(
    record: Record, bodies: BodyStates, force: Array, torque: Array, time: Array
) -> BodyStates:
    """Follow states without contact by Runge and Kutta's method, each over its own time [s]."""
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference.dynamics import dynamics_of

    if not len(time):
        return bodies
    dynamics = dynamics_of(record.mechanism)
    state, h = dynamics.pack(bodies), (time / _SUBSTEPS)[:, None, None]
    for _ in range(_SUBSTEPS):
        a = dynamics.derivative(state, force, torque)
        b = dynamics.derivative(state + h / 2 * a, force, torque)
        c = dynamics.derivative(state + h / 2 * b, force, torque)
        d = dynamics.derivative(state + h * c, force, torque)
        state = state + h / 6 * (a + 2 * b + 2 * c + d)
    return dynamics.unpack(state)
