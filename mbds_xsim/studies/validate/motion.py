"""Motions of a validation, packed for the viewer on its page, with contact shown below it.

Strips over time show heights, slips, and which spheres touch and when; tables compare the engines
with the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.ground import Impacts, Push, impacts_of, pushes_of
from mbds_xsim.checks.record import Record
from mbds_xsim.measure.result import Evidence, Validation
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Column, Table, table_of
from mbds_xsim.report.motion import Skeleton, encoded, in_base64, packed, skeleton
from mbds_xsim.report.themed import Style
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

_BYTES = 3_000_000
"""Most bytes that positions may take before base64 encoding."""
_LARGEST_STRIDE = 4
_FARTHEST = 1e150
"""Largest usable position [m]: squares of larger ones overflow, and JSON has no infinity."""
_LEAST = 0.05
"""Share of gravity's impulse below which the ground's is a rounding error of free flight."""


def pack(
    evidence: Evidence, results: Sequence[tuple[str, Style]], *, limit: int = _BYTES
) -> dict[str, Any]:
    """Return the viewer's data, ready for JSON; `results` are names and styles of the engines'.

    If positions would take more than `limit` bytes, frames are thinned out first, then
    trajectories are left out.
    """
    bones = skeleton(evidence.scene)
    stride, count = _thinning(evidence, len(bones.body), limit)
    motions = [
        None if motion is None else bones.positions(motion[:count])[:, ::stride]
        for motion in (evidence.reference, *evidence.trajectories)
    ]
    base = _base([motion for motion in motions if motion is not None])
    every = zip((("reference", None), *results), motions, (None, *evidence.errors), strict=True)
    entries = (
        (name, style, motion, None if error is None else error[:count, ::stride])
        for (name, style), motion, error in every
        if motion is not None
    )
    step = float(evidence.reference.time[1] - evidence.reference.time[0]) * stride
    return _scenery(evidence, bones, count) | packed(entries, base, evidence.scene.length, step)


def _thinning(evidence: Evidence, points: int, limit: int) -> tuple[int, int]:
    """Return the stride over frames and the number of trajectories that fit into `limit` bytes."""
    count, frames = evidence.reference.position.shape[:2]
    streams = 1 + sum(motion is not None for motion in evidence.trajectories)
    frame_bytes = streams * points * 3 * 2
    wanted = -(-count * frames * frame_bytes // limit)
    stride = min(max(1, wanted), _LARGEST_STRIDE, max(1, frames - 1))
    fitting = limit // (frame_bytes * -(-frames // stride))
    return stride, max(1, min(count, fitting))


def _base(motions: list[Array]) -> Array:
    """Take the reference and, beyond its end, the middle one of the other motions.

    If none is finite, the frame before is repeated.
    """
    base, others = motions[0].copy(), motions[1:]
    gone = ~_finite(base)
    for motion in others:  # all have the same start
        base[:, 0] = np.where(_finite(base[:, 0])[:, None, None], base[:, 0], motion[:, 0])
    base = _held(base)
    if others and gone.any():
        base[gone] = _middle(base[gone], [motion[gone] for motion in others])
    return np.nan_to_num(_held(base))


def _held(motion: Array) -> Array:
    """Repeat the last finite frame where a motion has ended."""
    held = motion.copy()
    for frame in range(1, held.shape[1]):
        gone = ~_finite(held[:, frame])
        held[gone, frame] = held[gone, frame - 1]
    return held


def _middle(end: Array, motions: list[Array]) -> Array:
    """Return in each row the motion least far from all others, and from where the reference ended.

    One that flies off is not taken while another is finite; rows without any are NaN.
    """
    places = np.stack([np.where(_finite(each)[..., None, None], each, np.nan) for each in motions])
    with np.errstate(invalid="ignore"):
        away = [
            sum(np.nan_to_num(np.abs(one - other).max(axis=(-1, -2))) for other in (end, *places))
            for one in places
        ]
    total = np.where(_finite(places), away, np.inf)
    return np.asarray(places[total.argmin(axis=0), np.arange(places.shape[1])])


def _finite(positions: Array) -> Mask:
    return np.asarray((np.abs(positions) < _FARTHEST).all(axis=(-1, -2)))


def _scenery(evidence: Evidence, bones: Skeleton, count: int) -> dict[str, Any]:
    batch = evidence.batch
    return {
        "trajectories": [
            {"index": int(batch.index[row]), "label": batch.label(row).removeprefix("trajectory ")}
            for row in range(count)
        ],
        "left_out": len(evidence.reference) - count,
        "points": len(bones.body),
        "radius": bones.radius.tolist(),
        "fixed": bones.fixed.tolist(),
        "edges": bones.edges,
        "ground": evidence.scene.ground is not None,
        "dimension": evidence.scene.dimension,
    }


def pack_strips(
    validation: Validation, evidence: Evidence, contacts: tuple[Contact | None, ...], count: int
) -> dict[str, Any]:
    """Return the data of the contact strips for `count` trajectories, ready for JSON.

    `contacts` lists the reference first, then the engine results; crashed ones are left out.
    """
    reference = validation.reference
    known = () if reference is None else reference.known_s
    available = [contact for contact in contacts if contact is not None]
    return {
        "step": evidence.scene.clock.frame,
        "frames": len(evidence.reference.time),
        "spheres": len(evidence.scene.contacts),
        "ends": list(known[:count]) or [None] * count,
        "slips": any(np.nan_to_num(contact.slip).any() for contact in available),
        "entries": [_entry(contact, count) for contact in available],
    }


def reading(evidence: Evidence, *, slips: bool) -> str:
    """Explain how to read the strips."""
    lanes = _lanes([sphere.body for sphere in evidence.scene.contacts])
    slip = (
        " Slip: mean speed of the points that touch along the ground, 0 where they roll or stick."
        if slips
        else ""
    )
    several = (
        " Where several may touch at once, frames cannot tell which one the ground pushed: all are "
        "marked."
        if lanes
        else ""
    )
    return (
        "Height: from the ground to the lowest contact sphere, below 0 where it overlaps."
        f"{slip} Touch{f' ({lanes})' if lanes else ''}: pale where the ground carries, solid below "
        "a triangle where it hits. In the motion, a dot marks where a sphere touches, a halo where "
        f"it hits.{several}"
    )


def _lanes(names: list[str]) -> str:
    """Name the contact sphere of each lane of the strips, if there are several."""
    if len(names) == 1:
        return ""
    if len(set(names)) == 1:
        return f"{len(names)} lanes, one for each sphere of {names[0]}"
    return f"lanes from above: {', '.join(names)}"


def _entry(contact: Contact, count: int) -> dict[str, str]:
    """Encode a contact; the flag bits of a step are its touching spheres, then its impact."""
    flags = np.concatenate([contact.touch, contact.impact[..., None]], axis=2)[:count]
    return {
        "gap": encoded(contact.gap[:count], "<f4"),
        "slip": encoded(contact.slip[:count], "<f4"),
        "flags": in_base64(np.packbits(flags, axis=2)),
    }


def tables(
    contacts: tuple[Contact | None, ...],
    entries: Sequence[tuple[str, Style]],
    index: Sequence[int],
) -> tuple[Table, ...]:
    """Make a table of each of the first trajectories, without columns that are empty in all.

    `contacts` and `entries` list the reference first, then the engine results.
    """
    ideal = contacts[0]
    assert ideal is not None
    contents = [
        [
            (entry, _texts(contact, row, ideal))
            for entry, contact in zip(entries, contacts, strict=True)
            if contact is not None and np.isfinite(contact.gap[row, 1:]).any()
        ]
        for row in range(len(index))
    ]
    every = [texts for rows in contents for _, texts in rows]
    kept = [k for k in range(len(_COLUMNS)) if any(texts[k] != quantity.NONE for texts in every)]
    columns = tuple(_COLUMNS[k] for k in kept)
    return tuple(
        table_of(
            (f"trajectory {number}", *columns),
            ((Cell(n, line=style), *(texts[k] for k in kept)) for (n, style), texts in rows),
        )
        for number, rows in zip(index, contents, strict=True)
    )


_COLUMNS = (
    Column("first touch", "End of the first frame interval in which the ground pushes"),
    Column("impacts", "Frame intervals with an impact"),
    Column("first rebound", "Height of the ball after its first impact, by its speed"),
    Column("restitution", "Speed after over before single impacts: median and range"),
    Column("deepest", "Deepest overlap with the ground in a recorded frame"),
    Column("rolls from", "When the ball has slid for the last time"),
)


def _texts(contact: Contact, row: int, ideal: Contact) -> list[str]:
    """Fill the columns for one trajectory of a motion, and compare it with the reference's."""
    episode, count = contact.episodes[row], int(contact.impact[row].sum())
    gap = contact.gap[row]
    known = np.isfinite(gap).any()
    return [
        "from the start" if contact.touch[row, 0].any() else _seconds(episode.first),
        str(count) if count else quantity.NONE,
        _rebound(episode.rebound, None if contact is ideal else ideal.episodes[row].rebound),
        _restitution(episode),
        quantity.length(max(0.0, -float(np.nanmin(gap)))) if known else quantity.NONE,
        _seconds(episode.rolls),
    ]


def _rebound(height: float | None, exact: float | None) -> str:
    if height is None:
        return quantity.NONE
    beside = f" ({100 * (height / exact - 1):+.2f} %)" if exact else ""
    return f"{height:.4f} m{beside}"


def _restitution(episode: Episode) -> str:
    if not len(episode.arriving):
        return quantity.NONE
    ratio = episode.leaving / episode.arriving
    spread = f" ({ratio.min():.3f} to {ratio.max():.3f})" if np.ptp(ratio) >= 1e-3 else ""
    return f"{np.median(ratio):.4f}{spread}"


def _seconds(time: float | None) -> str:
    return quantity.NONE if time is None else f"{time:.3f} s"


@dataclass(frozen=True, eq=False)
class Contact:
    """Contact of one motion's spheres with the ground, as the checks see it.

    A sphere touches in a step if it may reach the ground (`Push.reach`) and the ground pushes its
    group. If several of a group may reach it, frames cannot tell which of them did.
    """

    gap: Array
    """Gap between the ground and the lowest sphere [m], shape (trajectory, frame)."""
    slip: Array
    """Mean slip speed of the touching spheres [m/s], shape (trajectory, frame); NaN if none
    touches, and in impacts of anything but a ball."""
    touch: Mask
    """Spheres that touch in a step, shape (trajectory, step, sphere)."""
    impact: Mask
    """Steps with a significant impact (pushed, not `Push.supported`), shape (trajectory, step)."""
    episodes: tuple[Episode, ...]
    """One entry for each trajectory."""


@dataclass(frozen=True, eq=False)
class Episode:
    """Contact figures of one trajectory; None or empty if there is nothing to report."""

    first: float | None
    """End of the first step in which a sphere touches [s]."""
    arriving: Array
    """Downward speed of the sphere before each single impact [m/s], shape (single impact,)."""
    leaving: Array
    """Upward speed of the sphere after each single impact [m/s], shape (single impact,)."""
    rebound: float | None
    """Height that a ball reaches after its first impact, computed from its speed [m]."""
    rolls: float | None
    """Time at which a ball has slid for the last time and rolls [s]."""


def contacts_of(evidence: Evidence) -> tuple[Contact | None, ...]:
    """Find the contact of the reference, then of each engine result; empty without a ground."""
    scene, batch = evidence.scene, evidence.batch
    if scene.ground is None:
        return ()
    return tuple(
        None if motion is None else contact_of(scene, batch, motion)
        for motion in (evidence.reference, *evidence.trajectories)
    )


def contact_of(scene: Scene, batch: Batch, motion: Trajectory) -> Contact:
    """Find the contact of a motion; spheres of groups with another support never touch."""
    record = Record(scene, batch, motion)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        pushes = pushes_of(record)
        spheres = record.spheres
        touch = np.zeros((len(motion), record.steps, spheres.gap.shape[2]), dtype=bool)
        impact, clear = np.zeros(touch.shape[:2], dtype=bool), np.zeros_like(touch)
        for push in pushes:
            pushed = push.reach & (push.impulse[..., 2] > _LEAST * push.weight)[:, :, None]
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


def _mean_slip(slip: Array, touch: Mask) -> Array:
    """Average over the spheres that touch in the step before or after a frame."""
    near = np.zeros(slip.shape, dtype=bool)
    near[:, 1:] |= touch
    near[:, :-1] |= touch
    return np.asarray(np.where(near, slip, 0.0).sum(axis=2) / near.sum(axis=2))


def _episode(
    record: Record, hits: list[Impacts], row: int, touch: Mask, *, ball: bool, rolls: float | None
) -> Episode:
    step, arriving, leaving = (
        np.concatenate([np.empty(0), *(getattr(hit, name)[hit.row == row] for hit in hits)])
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
    """Find the instants from which a ball no longer slides, by the budget of the check `rolling`.

    After the last sliding frame, the slip is extrapolated at its last rate of decrease.
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
