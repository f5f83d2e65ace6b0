"""What bodies do to each other where their spheres touch: rebound, friction, and how near.

A collision of two balls in flight is taken apart as an impact on the ground is: the frame before it
is followed to the touch (`ground.at_touch`). What they have beside each other at the frame after it
they have had since, but for the loads. The impact is central, so that its impulse follows from the
approach, the slip and the scene's coefficients.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.checks.balances import groups_of
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.ground import at_impacts, at_touch, told_restitution
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.spheres import Neighbours, neighbours_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

_CENTRED = 1e-9  # [m], and of a moment that balls have alike about all axes
_OVER = 1e-6  # of the approach that changes beside each other once a collision is over
_EXACT = 1e-4  # of a frame: how exactly the time of a touch must be known
_SLOW = 3.0  # times what gravity or loads add in a frame: slower ones tell no restitution
_GLANCE = 0.1  # of the speed at which surfaces meet: what approaches slower is a glance


@dataclass(frozen=True, eq=False)
class Hits:
    """Collisions of one pair of balls, one entry each."""

    row: Index
    step: Index
    approach: Array
    """At the touch [m/s], shape (collision,)."""
    parting: Array
    """Afterwards [m/s]."""
    slip: Array
    """Of the points of contact past each other at the touch [m/s], shape (collision, 3)."""
    left: Array
    """The same afterwards."""
    gap: Array
    """Between the balls where the two motions meet, negative in each other [m]; NaN where they
    stay together."""

    @property
    def least(self) -> Array:
        """What errors of the approach are measured by at least [m/s].

        An engine that finds a touch late has another normal: next to nothing of the motion, and all
        of a glance's approach.
        """
        return np.asarray(_GLANCE * np.hypot(self.approach, rotation.norm(self.slip)))


@check("collision restitution", "restitution")
def collision_restitution(record: Record) -> Figures | None:
    """Compare the delivered with the scene's coefficient of restitution; None without balls."""
    found = _all(record)
    if not found:
        return None
    assert record.scene.collisions is not None
    wanted, told, off = record.scene.collisions.restitution, [], []
    for pair, hits in found.items():
        loads = rotation.norm(_pull(record, pair)[hits.row, hits.step])
        fast = hits.approach > _SLOW * np.maximum(record.fall, record.frame * loads)
        error = np.abs(hits.parting - wanted * hits.approach)
        off.append(np.where(fast, error / np.maximum(hits.approach, hits.least), np.nan))
        plain = fast & (hits.approach > hits.least)
        told += (hits.parting[plain] / hits.approach[plain]).tolist()
    note = told_restitution(told, wanted)
    return Figures(_placed(record, found, off), _names(record, found), note)


@check("collision friction", "friction")
def collision_friction(record: Record) -> Figures | None:
    """Compare tangential impulses with Coulomb's over μ times the normal ones; None without balls.

    They stop the slip, or are μ times the normal impulse against it. Of balls whose inertia is not
    even only what is above μ times it is seen.
    """
    found = _all(record)
    if not found:
        return None
    off = [_aside(record, pair, hits) for pair, hits in found.items()]
    return Figures(_placed(record, found, off), _names(record, found))


@check("collision gap", "contact_gap")
def collision_gap(record: Record) -> Figures | None:
    """Measure how far balls are from each other where they rebound, over the scene's length.

    What the declared time of contact explains is left out where they overlap, and all of it where
    none is declared. None without balls.
    """
    found, time = _all(record), record.contact_time
    if not found:
        return None
    off = [
        np.maximum(hits.gap, 0.0 if time is None else -hits.gap - time * hits.approach)
        for hits in found.values()
    ]
    parts = _placed(record, found, [gap / record.scene.length for gap in off])
    return Figures(parts, _names(record, found))


@functools.lru_cache(maxsize=64)
def pairs_of_balls(mechanism: Mechanism) -> list[int]:
    """Pairs of spheres that are balls: of bodies that nothing else joins, around their centres."""
    alone = {group[0] for group in groups_of(mechanism) if len(group) == 1}
    spheres = mechanism.sphere_body.tolist()
    centred = np.linalg.norm(mechanism.sphere_offset, axis=1) <= _CENTRED
    ball = [
        body in alone and spheres.count(body) == 1 and bool(centred[k])
        for k, body in enumerate(spheres)
    ]
    held = {body for joint in mechanism.joints for body in (joint.parent, joint.child)}
    held |= {body for pair in (*mechanism.distances, *mechanism.springs) for body in pair.bodies}
    return [
        k
        for k, pair in enumerate(mechanism.sphere_pairs.tolist())
        if all(ball[sphere] and spheres[sphere] not in held for sphere in pair)
    ]


@functools.lru_cache(maxsize=1)
def _all(record: Record) -> dict[int, Hits]:
    """Collisions that can be taken apart, by the number of the pair."""
    return {pair: _of_pair(record, pair) for pair in pairs_of_balls(record.mechanism)}


def _of_pair(record: Record, pair: int) -> Hits:
    mechanism, frame = record.mechanism, record.frame
    one, other = mechanism.sphere_body[mechanism.sphere_pairs[pair]]
    reach = mechanism.sphere_radius[mechanism.sphere_pairs[pair]]

    def look(bodies: BodyStates) -> Neighbours:
        return neighbours_of(mechanism, bodies)[:, pair]

    row, step = np.nonzero(_alone(record, pair))
    _, before, falling = at_touch(record, row, step, step, look)
    _, after, rising = at_touch(record, row, step, step + 1, look)
    end, pull = record.bodies[row, step + 1], _pull(record, pair)[row, step]
    speed = end.velocity[:, one] - end.velocity[:, other] - (frame - falling)[:, None] * pull
    turning = reach @ end.angular_velocity[:, [one, other]]
    # A soft contact turns with the balls as long as it lasts; those that stay together do not part.
    parted = (after.climb > 0.0) & (rising <= 0.0)
    normal = np.where(parted[:, None], after.normal, before.normal)
    parting = rotation.dot(speed, normal)
    left = speed - parting[:, None] * normal - rotation.cross(turning, normal)
    rates = 1.0 / np.where(parted, after.climb, np.nan) - 1.0 / before.climb
    gap = -(frame - falling + rising) / rates
    # A graze that is no touch comes as near as one.
    exact = np.abs(before.gap) <= _EXACT * frame * -before.climb
    hit = exact & (falling >= 0.0)
    return Hits(
        row=row[hit],
        step=step[hit],
        approach=-before.climb[hit],
        parting=parting[hit],
        slip=before.slip[hit],
        left=left[hit],
        gap=gap[hit],
    )


def _pull(record: Record, pair: int) -> Array:
    """What loads do to the balls of a pair beside each other [m/s²], (trajectory, step, 3)."""
    mechanism = record.mechanism
    one, other = mechanism.sphere_body[mechanism.sphere_pairs[pair]]
    given = record.force / mechanism.mass[:, None]
    return np.asarray(given[:, :, one] - given[:, :, other])


def _alone(record: Record, pair: int) -> Mask:
    """Steps in which a pair may come to touch, and is past it, and nothing else touches its balls.

    It is past it where the balls are apart again, or do not push each other in the step after.
    """
    mechanism, near = record.mechanism, record.neighbours
    own, gap = mechanism.sphere_pairs[pair], near.gap[..., pair]
    one, other = mechanism.sphere_body[own]
    speed = record.bodies.velocity[:, :, one] - record.bodies.velocity[:, :, other]
    pushed = rotation.norm(np.diff(speed, axis=1) - record.frame * _pull(record, pair))
    over = gap[:, 1:] > 0.0
    over[:, :-1] |= pushed[:, 1:] < _OVER * near.speed[:, :-2, pair]
    others = np.asarray(np.isin(mechanism.sphere_pairs, own).any(axis=1))
    others[pair] = False
    alone = record.parted[..., others].all(axis=2) & record.clear[..., own].all(axis=2)
    return np.asarray(~record.parted[..., pair] & (gap[:, :-1] > 0.0) & over & alone)


def _aside(record: Record, pair: int, hits: Hits) -> Array:
    """What tangential impulses are beside Coulomb's, over μ times the normal ones, (collision,)."""
    mechanism, collisions = record.mechanism, record.scene.collisions
    assert collisions is not None
    spheres = mechanism.sphere_pairs[pair]
    bodies, radius = mechanism.sphere_body[spheres], mechanism.sphere_radius[spheres]
    moments = np.linalg.eigvalsh(mechanism.inertia[bodies])
    yields = float(np.sum(1.0 / mechanism.mass[bodies]))
    across = yields + float(np.sum(radius**2 / moments.mean(axis=1)))
    push = (hits.approach + hits.parting) / yields
    most = collisions.friction * push
    even = bool((np.ptp(moments, axis=1) <= _CENTRED * moments.max(axis=1)).all())
    given, size = (hits.left - hits.slip) / across, rotation.norm(hits.slip)
    needed = np.minimum(most, size / across)
    wanted = -hits.slip * (needed / np.maximum(size, np.finfo(float).tiny))[:, None]
    off = rotation.norm(given - wanted) if even else np.maximum(rotation.norm(given) - most, 0.0)
    scale = np.maximum(push, hits.least / yields)
    return np.asarray(off / (scale * (collisions.friction or 1.0)))


def _placed(record: Record, found: dict[int, Hits], values: list[Array]) -> Array:
    """Put values of collisions at the frames after them, (trajectory, frame, pair)."""
    hits = zip(found.values(), values, strict=True)
    return at_impacts(record, [(each.row, each.step, off) for each, off in hits])


def _names(record: Record, found: dict[int, Hits]) -> list[str]:
    of = [sphere.body for sphere in record.scene.contacts]
    return [f"{of[a]} and {of[b]}" for a, b in record.mechanism.sphere_pairs[list(found)].tolist()]
