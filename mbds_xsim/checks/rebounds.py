"""Restitution of impacts on the ground: of those that rebound, and of those that hardly do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.ground import (
    SLOW,
    Push,
    at_touch,
    balls_of,
    fast_impacts_of,
    free_acceleration,
    impacts_of,
    one_sphere,
    undisturbed,
)
from mbds_xsim.checks.record import Record

_MORE = 1.5  # times the accelerations at a step's ends, for those in between
_LONGEST = 2.6  # times the declared duration: the longest contact of joined bodies (measured)


@check("restitution", "restitution")
def restitution(record: Record) -> Figures | None:
    """Compare the delivered coefficient of restitution with the scene's; None without balls.

    Only balls count, whose sphere is around the centre of mass: nothing else affects their rebound.
    """
    pushes = balls_of(record)
    if not pushes:
        return None
    wanted = record.ground.restitution
    impacts = (fast_impacts_of(record, push) for push in pushes)
    errors = [np.abs(hits.leaving / hits.arriving - wanted) for hits in impacts]
    return rebound_figures(record, pushes, errors, wanted)


def rebound_figures(
    record: Record, pushes: list[Push], errors: list[Array], wanted: float, remark: str = ""
) -> Figures:
    """Put errors of fast impacts, and what dull ones miss of a restitution, at the frames after.

    Args:
        record: Record of the motion.
        pushes: Groups of bodies, at least one.
        errors: Errors of the fast impacts of each group.
        wanted: Restitution that dull impacts must allow.
        remark: Remark on the fast impacts for the note.
    """
    impacts = [fast_impacts_of(record, push) for push in pushes]
    dull = [_dull_impacts_of(record, push) for push in pushes]
    placed = [
        (
            np.append(fast.row, slow.row),
            np.append(fast.step, slow.step),
            np.append(error, np.maximum(wanted - slow.most, 0.0)),
        )
        for fast, slow, error in zip(impacts, dull, errors, strict=True)
    ]
    ratios = np.concatenate([hits.leaving / hits.arriving for hits in impacts]).tolist()
    note = restitution_note(ratios, record.ground.restitution) + remark
    most = np.concatenate([slow.most for slow in dull])
    few = most[most < wanted]
    if len(few):
        note += f"; {len(few)} more deliver {few.max():.2g} at most"
    return Figures(at_impacts(record, placed), [push.name for push in pushes], note)


def at_impacts(record: Record, groups: Sequence[tuple[Index, Index, Array]]) -> Array:
    """Put values of impacts, by row and step, at the frames after, (trajectory, frame, group)."""
    parts = np.full((*record.finite.shape, len(groups)), np.nan)
    parts[:, 0] = 0.0  # not every trajectory bounces
    for k, (row, step, values) in enumerate(groups):
        parts[row, step + 1, k] = values
    return parts


def restitution_note(ratios: list[float], wanted: float) -> str:
    """Describe the coefficients of restitution that were delivered."""
    if not ratios:
        return f"no impact shows it, the scene has {wanted:.4f}"
    text = f"{min(ratios):.4f} to {max(ratios):.4f} delivered, median {np.median(ratios):.4f}"
    return f"{text}, the scene has {wanted:.4f}"


class _DullImpacts(NamedTuple):
    """Fast impacts of one sphere each whose rebound is not seen, one entry per impact."""

    row: Index
    step: Index
    most: Array
    """Most restitution that the next frame allows: the leaving speed over the arriving one."""


def _dull_impacts_of(record: Record, push: Push) -> _DullImpacts:
    """Find the single impacts that may leave a sphere on the ground, from where it was in flight.

    If a sphere leaves at a speed u at a time t before the frame ends, and nothing pulls it back by
    more than a, it is then at least u t − a t²/2 high, or has come down again before, so that
    u < a t/2. Impacts count that must have ended: t is longer than the declared contact, and than
    a rebound takes back a sphere's way into the ground. None count if no contact time is declared,
    or in groups with springs, dampers or drives.
    """
    wanted, time = record.ground.restitution, record.contact_time
    if time is None or not wanted or _is_sprung(record, push):
        none = np.zeros(0, dtype=int)
        return _DullImpacts(none, none, np.zeros(0))
    alone = (push.reach.sum(axis=2) == 1) & undisturbed(record, push)
    begins = push.untouched[:, :-1] & alone & (push.impulse[..., 2] > 0.0)
    hits = impacts_of(record, push)
    begins[hits.row, hits.step] = False
    row, step = np.nonzero(begins)
    sphere = push.spheres[push.reach[row, step].argmax(axis=1)]
    _, before, fall = at_touch(
        record, row, step, step, lambda bodies: one_sphere(record, bodies, sphere)
    )
    pull, left = _pull(record, row, step, sphere), record.frame - fall
    ended = left > time * (_LONGEST + 1.0 / wanted)
    fast = (-before.climb > SLOW * record.frame * pull) & (fall >= 0.0) & ended
    row, step, sphere, left = row[fast], step[fast], sphere[fast], left[fast]
    gap = np.maximum(record.spheres.gap[row, step + 1, sphere], 0.0)
    most = (gap / left + 0.5 * pull[fast] * left) / -before.climb[fast]
    return _DullImpacts(row, step, np.asarray(most))


def _pull(record: Record, row: Index, step: Index, sphere: Index) -> Array:
    """Bound the accelerations of spheres without the ground in a step [m/s²], one per impact."""
    pulls = []
    for frame in (step, step + 1):
        free = free_acceleration(record, row, step, sphere, record.bodies[row, frame])
        pulls += [record.pulls[row, frame, sphere], _MORE * np.abs(free[:, 2])]
    return np.asarray(np.max(pulls, axis=0))


def _is_sprung(record: Record, push: Push) -> bool:
    """Whether springs, dampers or drives join a group's bodies.

    They may push a sphere back within a step, by forces that neither of its ends shows.
    """
    mechanism, group = record.mechanism, {*push.bodies}
    loaded = [(j.parent, j.child) for j in mechanism.joints if j.complies or j.driven]
    return any(group & {*pair} for pair in (*loaded, *(s.bodies for s in mechanism.springs)))
