"""Where the ground is: how deep spheres sink into it, and at what distance it pushes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.ground import Push, pushes_of
from mbds_xsim.checks.impacts import Impacts, impacts_of

Array = NDArray[np.float64]

# Times the declared duration and the arriving speed. Half of it is what a spring makes that lasts
# as long; joined bodies make one last longer, measured up to 2.6 times.
_LONGEST = 2.0
_LASTING = 4.0  # how much sharper than in impacts it is known where the ground is that carries


def penetration(record: Record) -> Finding | None:
    """Measure the deepest overlap of a contact sphere with the ground over the scene's length.

    Of recorded frames: an impact may go deeper between them. None without contact.
    """
    scene = record.scene
    if not scene.contacts:
        return None
    overlap = np.maximum(-record.spheres.gap, 0.0)
    share = np.nanmax(overlap / record.mechanism.sphere_radius, initial=0.0)
    return Finding.of(
        "penetration",
        "1",
        overlap / scene.length,
        budget=scene.budget.penetration,
        names=tuple(sphere.body for sphere in scene.contacts),
        note=f"{share:.2g} of a radius",
    )


def contact_gap(record: Record) -> Finding | None:
    """Measure how far spheres are from the ground that carries them, over the scene's length.

    At frames where the ground carries a steady weight it is the gap of the lowest sphere, four
    times that where it stays for three of them; in a
    single impact the gap at which the motions before and after it meet. Of those beside the centre
    of mass, what the declared time of contact explains is left out below the ground, and all of it
    where none is declared. None without contact.
    """
    pushes = pushes_of(record)
    if not pushes:
        return None
    gaps = np.stack([_gaps(record, push) for push in pushes], axis=-1)
    return Finding.of(
        "contact gap",
        "1",
        gaps / record.scene.length,
        budget=record.scene.budget.contact_gap,
        names=tuple(push.name for push in pushes),
    )


def _gaps(record: Record, push: Push) -> Array:
    """Distances where they are known [m], NaN elsewhere, shape (trajectory, frame)."""
    gap = push.over.gap.min(axis=2)
    found = np.where(push.resting, np.abs(gap), np.nan)
    # A gap that stays is where the ground is; one of a frame may be a hop.
    around = np.minimum(np.minimum(found[:, :-2], found[:, 1:-1]), found[:, 2:])
    found[:, 1:-1] = np.fmax(found[:, 1:-1], _LASTING * around)
    hits = impacts_of(record, push)
    found[hits.row, hits.step + 1] = np.abs(hits.gap) if push.ball else _off(record, hits)
    found[:, 0] = np.nan_to_num(found[:, 0])  # not every trajectory touches
    return np.asarray(found)


def _off(record: Record, hits: Impacts) -> Array:
    """Distance from the ground at which a soft contact cannot meet [m], one an impact."""
    if record.contact_time is None:
        return np.maximum(hits.gap, 0.0)
    return np.maximum(hits.gap, -hits.gap - _LONGEST * record.contact_time * hits.arriving)
