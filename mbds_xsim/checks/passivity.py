"""Does contact create energy, and more of it than the scene's own law of impact does?

A rigid impact changes the kinetic energy by the sum over its contacts of p·(u⁻ + u⁺)/2, with p the
impulse and u the velocities of the contact point. By Newton's restitution the normal part of it is
−(1 − e) p |u⁻|/2. In the tangential part p·u⁺ is never positive, as friction opposes the slip it
leaves; but p·u⁻ may be, where the coupling of an eccentric impact turns the slip round. Newton's
and Coulomb's laws together are then not passive (Kane & Levinson 1985, Dynamics; Brach 1989,
J. Appl. Mech. 56, 133), and an engine that keeps to them gains energy as they do.
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.energy import energy_of, input_work
from mbds_xsim.checks.finding import Figures, Record, check
from mbds_xsim.checks.ground import Push, pushes_of
from mbds_xsim.checks.impacts import impacts_of


@check("passivity", "passivity")
def passivity(record: Record) -> Figures | None:
    """Measure the rise of E − W that the law of impact does not explain, over the energy scale.

    Above its running minimum, among frames in which no contact stores energy. None without
    contact, or where something else supports a body that may touch.
    """
    pushes = _all_pushes(record)
    if not pushes:
        return None
    gain = sum((law_gain(record, push) for push in pushes), np.zeros(1))
    explained = np.cumsum(gain, axis=1)
    rise, scale = _rise(record, pushes, explained)
    share = np.nan_to_num(explained[:, -1] / scale)
    note = f"impacts may add up to {share.max():.2g} of the scale by their own law"
    return Figures(rise[..., None], note=note if share.any() else "")


@check("energy rise", None)
def energy_rise(record: Record) -> Figures | None:
    """Show the whole rise of E − W, explained or not, where the law of impact explains any."""
    pushes = _all_pushes(record)
    if all(push.ball for push in pushes):
        return None
    rise, _ = _rise(record, pushes, np.zeros((1, record.steps)))
    return Figures(rise[..., None])


def law_gain(record: Record, push: Push) -> Array:
    """Give the energy that impacts may add by their own law [J], shape (trajectory, step).

    Of a single impact between two frames in flight it follows from the slip on arrival and the
    impulse. Where more may have happened in a step, it is bounded by the fastest slip.
    """
    gain = np.zeros(push.impulse.shape[:2])
    if push.ball:
        return gain
    ground, slip = record.ground, np.linalg.norm(push.over.slip, axis=-1)
    fastest = np.where(push.reach, np.maximum(slip[:, 1:], slip[:, :-1]), 0.0).max(axis=2)
    unclear = push.reach.any(axis=2) & ~push.steady
    most = 0.5 * ground.friction * np.maximum(push.impulse[..., 2], 0.0) * fastest
    gain[unclear] = most[unclear]
    hits = impacts_of(record, push)
    forward = np.sum(hits.impulse[:, :2] * hits.slip, axis=1)
    lost = (1.0 - ground.restitution) * hits.impulse[:, 2] * hits.arriving
    gain[hits.row, hits.step] = 0.5 * np.maximum(forward - lost, 0.0)
    return np.asarray(np.nan_to_num(gain))


def _all_pushes(record: Record) -> list[Push]:
    """Groups with contact, none where the ground's part in one of them is not known."""
    pushes = pushes_of(record)
    known = sum(len(push.spheres) for push in pushes)
    return pushes if known == len(record.mechanism.sphere_body) else []


def _rise(record: Record, pushes: list[Push], explained: Array) -> tuple[Array, Array]:
    """Rise above the running minimum over the scale, NaN where not compared; and the scale [J]."""
    energy = energy_of(record)
    left = energy.total - input_work(record)
    left[:, 1:] -= explained
    compared, most = record.finite.copy(), left.copy()
    for push in pushes:
        compared &= settled(push)
        most += stored(record, push)
    return risen(left, most, compared) / energy.scale[:, None], energy.scale


def risen(least: Array, most: Array, compared: Mask) -> Array:
    """Rise from the lowest that energy can have been to what it is at least.

    In between is what contacts may store. Shape (trajectory, frame), NaN where not compared.
    """
    lowest = np.minimum.accumulate(np.where(compared, most, np.inf), axis=1)
    rise = np.where(compared, np.maximum(least - lowest, 0.0), np.nan)
    rise[:, 0] = 0.0
    return np.asarray(rise)


def settled(push: Push) -> Mask:
    """Frames at which a group's contacts store no more than `stored`, (trajectory, frame).

    Those in flight, those around which the ground only carries, and the start: what overlaps
    there was put there. A slow impact, too, stores the energy it arrives with.
    """
    found = push.untouched | push.resting
    found[:, 0] = True
    return np.asarray(found)


def stored(record: Record, push: Push) -> Array:
    """Most that overlaps under the weight store [J]: weight times overlap, (trajectory, frame)."""
    return np.asarray(push.mass * record.pull * np.maximum(-push.over.gap.min(axis=2), 0.0))
