"""Single impacts between two frames in flight, taken apart by the scene's own motion.

The frame before is followed forwards, and the frame after backwards, to where the sphere touches
the ground. What lies between the two states is the impact: its impulse is the one that the
momentum of the frames shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.flow import FIELDS
from mbds_xsim.checks.ground import Push, Spheres, pushes_of, spheres_of
from mbds_xsim.joint_space import BodyStates

__all__ = ["Impacts", "eccentric_restitution", "impacts_of", "restitution", "untouched"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_REFINEMENTS = 4  # Newton's steps to the time of touch
_SUBSTEPS = 4  # of Runge and Kutta to it
_APART = 0.5  # of the flight that follows a rebound: a step with so much time left has two impacts
_SLOW = 3.0  # times what gravity adds in a frame: slower impacts are no measure of restitution


@dataclass(frozen=True, eq=False)
class Impacts:
    """Impacts of one sphere each, one entry an impact."""

    row: Index
    step: Index
    arriving: Array
    """Downward speed of the sphere [m/s]."""
    leaving: Array
    """Upward speed [m/s]."""
    slip: Array
    """Horizontal velocity of the sphere's lowest point on arrival [m/s], shape (impact, 2)."""
    impulse: Array
    """Of the ground [N·s], shape (impact, 3)."""
    gap: Array
    """Between sphere and ground where the two motions meet, negative below it [m]."""


def restitution(record: Record) -> Finding | None:
    """Compare the delivered with the scene's coefficient of restitution; None without balls.

    Only for spheres around centres of mass, whose rebound nothing else has a part in.
    """
    pushes = [push for push in pushes_of(record) if push.ball]
    if not pushes:
        return None
    parts, note = _delivered(record, pushes)
    return Finding.of(
        "restitution",
        "1",
        parts,
        budget=record.scene.budget.restitution,
        names=tuple(push.name for push in pushes),
        note=note,
    )


def eccentric_restitution(record: Record) -> Finding | None:
    """Show the same of single impacts beside centres of mass; None without spheres there."""
    pushes = [push for push in pushes_of(record) if not push.ball]
    if not pushes:
        return None
    parts, note = _delivered(record, pushes)
    return Finding.of(
        "eccentric restitution",
        "1",
        parts,
        budget=None,
        names=tuple(push.name for push in pushes),
        note=note,
    )


def _delivered(record: Record, pushes: list[Push]) -> tuple[Array, str]:
    """Deviations from the coefficient, (trajectory, frame, group), and what was delivered."""
    ground = record.scene.ground
    assert ground is not None
    parts = np.full((*record.finite.shape, len(pushes)), np.nan)
    parts[:, 0] = 0.0  # not every trajectory bounces
    slow = _SLOW * record.frame * float(np.linalg.norm(record.scene.gravity))
    ratios: list[float] = []
    for k, push in enumerate(pushes):
        hits = impacts_of(record, push)
        fast = hits.arriving > slow
        ratio = (hits.leaving / hits.arriving)[fast]
        parts[hits.row[fast], hits.step[fast] + 1, k] = np.abs(ratio - ground.restitution)
        ratios += ratio.tolist()
    if not ratios:
        return parts, f"no impact, the scene has {ground.restitution:.4f}"
    told = f"{min(ratios):.4f} to {max(ratios):.4f} delivered, median {np.median(ratios):.4f}"
    return parts, f"{told}, the scene has {ground.restitution:.4f}"


def untouched(record: Record, push: Push) -> NDArray[np.bool_]:
    """Tell in which frames no sphere of a group touches, shape (trajectory, frame)."""
    gap = spheres_of(record.mechanism, record.bodies).gap[:, :, push.spheres]
    return np.asarray((gap > 0.0).all(axis=2))


def impacts_of(record: Record, push: Push) -> Impacts:
    """Find the steps in which one sphere, and no other of its group, hits the ground once."""
    free = untouched(record, push)
    alone = push.reach.sum(axis=2) == 1
    row, step = np.nonzero(free[:, 1:] & free[:, :-1] & alone & (push.impulse[..., 2] > 0.0))
    sphere = push.spheres[push.reach[row, step].argmax(axis=1)]
    before, falling = _at_touch(record, row, step, step, sphere)
    after, rising = _at_touch(record, row, step, step + 1, sphere)
    pull = float(np.linalg.norm(record.scene.gravity)) or np.finfo(float).tiny
    left = record.frame - falling + rising
    arriving, leaving = -before.climb, after.climb
    single = (arriving > 0.0) & (leaving > 0.0) & (falling >= 0.0) & (rising <= 0.0)
    single &= left < np.maximum(_APART * 2.0 * leaving / pull, 0.1 * record.frame)
    return Impacts(
        row=row[single],
        step=step[single],
        arriving=arriving[single],
        leaving=leaving[single],
        slip=before.slip[single],
        impulse=push.impulse[row, step][single],
        gap=(-left / (1.0 / arriving + 1.0 / leaving))[single],
    )


def _at_touch(
    record: Record, row: Index, step: Index, frame: Index, sphere: Index
) -> tuple[Spheres, Array]:
    """Follow frames to the touch of a sphere: the sphere there, and the time to it [s].

    Forwards from the step's first frame, backwards from its last; NaN where it stays clear.
    """
    bodies = BodyStates(*(getattr(record.bodies, name)[row, frame] for name in FIELDS))
    force, torque = record.batch.force[row, step], record.batch.torque[row, step]
    sense = np.where(frame > step, -1.0, 1.0)
    time, limit = np.zeros(len(row)), 1.5 * record.frame
    there, here = bodies, _one(record, bodies, sphere)
    pull = float(np.linalg.norm(record.scene.gravity))
    for k in range(_REFINEMENTS + 1):
        speed = sense * here.climb
        # The first guess is a parabola's, on which Newton's steps cannot go astray.
        square = np.sqrt(speed**2 + 2.0 * pull * np.maximum(here.gap, 0.0))
        ahead = 2.0 * here.gap / (square - speed) if k == 0 else -here.gap / speed
        time = np.clip(time + sense * ahead, -limit, limit)
        there = _followed(record, bodies, force, torque, time)
        here = _one(record, there, sphere)
    reached = (np.abs(time) <= record.frame) & (np.abs(here.gap) < 1e-6 * record.scene.length)
    return here, np.where(reached, time, np.nan)


def _one(record: Record, bodies: BodyStates, sphere: Index) -> Spheres:
    spheres, each = spheres_of(record.mechanism, bodies), np.arange(len(sphere))
    return Spheres(
        spheres.gap[each, sphere], spheres.climb[each, sphere], spheres.slip[each, sphere]
    )


def _followed(
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
