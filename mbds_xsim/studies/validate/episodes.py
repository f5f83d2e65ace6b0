"""What the page shows of contact, as the checks' own view of the ground gives it.

A contact sphere touches in a step if it may reach the ground (`Push.reach`) and the ground pushes
its group. Where several of a group may, frames cannot tell which of them did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.finding import Record
from mbds_xsim.checks.ground import Impacts, Push, impacts_of, pushes_of
from mbds_xsim.measure.result import Evidence
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

_LEAST = 0.05
"""Of the impulse of gravity: a smaller one of the ground is the rounding of a flight."""


@dataclass(frozen=True, eq=False)
class Contact:
    """How the contact spheres of one motion meet the ground."""

    gap: Array
    """Between the ground and the lowest point [m], shape (trajectory, frame)."""
    slip: Array
    """Mean slip of the touching spheres, NaN where none touches or where the ground hits several
    that may touch [m/s], shape (trajectory, frame)."""
    touch: Mask
    """Spheres that touch in a step, shape (trajectory, step, sphere)."""
    impact: Mask
    """Steps with an impact that counts, shape (trajectory, step)."""
    episodes: tuple[Episode, ...]
    """One a trajectory."""


@dataclass(frozen=True, eq=False)
class Episode:
    """The contact of one trajectory in figures; None or empty where there is nothing to tell."""

    first: float | None
    """End of the first step in which a sphere touches [s]."""
    arriving: Array
    """Downward speed of the sphere in each single impact [m/s], shape (single impact,)."""
    leaving: Array
    """Upward speed [m/s], shape (single impact,)."""
    rebound: float | None
    """Height that a ball reaches after its first impact, by its speed [m]."""
    rolls: float | None
    """When a ball has slid for the last time and rolls [s]."""


def contacts_of(evidence: Evidence) -> tuple[Contact | None, ...]:
    """Look at the reference, then at the engine results; empty for a scene without contact."""
    scene, batch = evidence.scene, evidence.batch
    if not scene.contacts:
        return ()
    return tuple(
        None if motion is None else contact_of(scene, batch, motion)
        for motion in (evidence.reference, *evidence.trajectories)
    )


def contact_of(scene: Scene, batch: Batch, motion: Trajectory) -> Contact:
    """Look at the contact of a motion; spheres of groups that hang on the world never touch."""
    record = Record(scene, batch, motion)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        pushes = pushes_of(record)
        spheres = record.spheres
        touch = np.zeros((len(motion), record.steps, spheres.gap.shape[2]), dtype=bool)
        impact, clear = np.zeros(touch.shape[:2], dtype=bool), np.zeros_like(touch)
        for push in pushes:
            pushed = push.reach & _pushed(push)[:, :, None]
            touch[:, :, push.spheres] = pushed
            impact |= pushed.any(axis=2) & ~push.supported
            clear[:, :, push.spheres] = pushed & (push.supported | push.ball)[:, :, None]
        gap = spheres.gap.min(axis=2)
        slip = _mean_slip(np.linalg.norm(spheres.slip, axis=-1), clear)
        hits = [impacts_of(record, push) for push in pushes]
        ball = len(pushes) == 1 and pushes[0].ball
        rolls = _rolls(record, pushes[0]) if ball else [None] * len(gap)
        episodes = [
            _episode(record, hits, row, touch[row].any(axis=1), ball=ball, rolls=rolls[row])
            for row in range(len(gap))
        ]
    return Contact(gap, slip, touch, impact, tuple(episodes))


def _pushed(push: Push) -> Mask:
    """Steps in which the ground pushes a group, shape (trajectory, step)."""
    return np.asarray(push.impulse[..., 2] > _LEAST * push.weight)


def _mean_slip(slip: Array, touch: Mask) -> Array:
    """Mean over the spheres that touch in the step before or after a frame."""
    near = np.zeros(slip.shape, dtype=bool)
    near[:, 1:] |= touch
    near[:, :-1] |= touch
    return np.asarray(np.where(near, slip, 0.0).sum(axis=2) / near.sum(axis=2))


def _episode(
    record: Record, hits: list[Impacts], row: int, touch: Mask, *, ball: bool, rolls: float | None
) -> Episode:
    step, arriving, leaving = (
        np.concatenate([np.empty(0), *(getattr(found, name)[found.row == row] for found in hits)])
        for name in ("step", "arriving", "leaving")
    )
    order, pull = np.argsort(step, kind="stable"), float(np.linalg.norm(record.scene.gravity))
    return Episode(
        first=float((touch.argmax() + 1) * record.frame) if touch.any() else None,
        arriving=arriving[order],
        leaving=leaving[order],
        rebound=float(leaving[order][0] ** 2 / (2 * pull)) if ball and len(step) else None,
        rolls=rolls,
    )


def _rolls(record: Record, push: Push) -> list[float | None]:
    """Instants from which a ball no longer slides, by the budget of the check `rolling`.

    Between the last frame of a slide and the next, a slip goes on to fall as it did before.
    """
    slip = np.linalg.norm(push.over.slip[:, :, 0], axis=-1)
    speed = np.linalg.norm(record.bodies.velocity[:, :, push.bodies[0]], axis=-1)
    fastest = np.fmax.reduce(speed, axis=1)[:, None]
    slides = ~(push.resting & (slip <= record.scene.budget.rolling * fastest))
    return [_last_slide(record, slides[row], slip[row]) for row in range(len(slides))]


def _last_slide(record: Record, slides: Mask, slip: Array) -> float | None:
    frames = np.flatnonzero(slides)
    if not len(frames):
        return 0.0
    last = int(frames[-1])
    if last + 1 == len(slides):
        return None
    rate = slip[last - 1] - slip[last] if last else 0.0
    share = slip[last] / rate if rate > slip[last] else 1.0
    return float((last + share) * record.frame)
