"""Collisions between bodies: their rebound, their friction, and the distance where they happen.

A collision of two balls in flight is isolated like an impact on the ground: the frame before it is
followed to the touch (`ground.at_touch`). The relative velocity at the frame after it is that just
after the collision, except for the loads. The impact is central, so its impulse follows from the
approach, the slip and the scene's coefficients.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask, Picked
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.ground import at_touch
from mbds_xsim.checks.rebounds import at_impacts, restitution_note
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.spheres import Neighbours, neighbours_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

_CENTRED = 1e-9  # tolerance [m], and relative of moments of inertia that are equal about all axes
_OVER = 1e-6  # share of the relative speed; once a collision is over, it changes by less
_EXACT = 1e-4  # share of a frame to which the time of a touch must be known
_SLOW = 3.0  # times what gravity or loads add in a frame; slower impacts show no restitution
_TINY = np.finfo(float).tiny
_GLANCE = 0.1  # share of the speed at which surfaces meet; a slower approach is a glance


@dataclass(frozen=True, eq=False)
class Hits(Picked):
    """Collisions of one pair of balls, one entry per collision."""

    row: Index
    step: Index
    approach: Array
    """Approach speed at the touch [m/s], shape (collision,)."""
    parting: Array
    """Parting speed afterwards [m/s], shape (collision,)."""
    slip: Array
    """Slip between the contact points at the touch [m/s], shape (collision, 3)."""
    aside: Array
    """Tangential impulse on the first ball that changed the slip [N·s], shape (collision, 3)."""
    stopping: Array
    """The same that would have stopped the slip [N·s], shape (collision, 3)."""
    straight: Array
    """Cosine of half the angle by which the slip turned, shape (collision,)."""
    gap: Array
    """Distance of the balls where the two motions meet [m], negative if they overlap; NaN if they
    stay together."""

    @property
    def least(self) -> Array:
        """Least scale for errors of the approach [m/s].

        An engine that finds a touch late has a slightly different normal, which hardly changes the
        motion, but may change all of a glance's approach.
        """
        return np.asarray(_GLANCE * np.hypot(self.approach, rotation.norm(self.slip)))


@check("collision restitution", "restitution")
def collision_restitution(record: Record) -> Figures | None:
    """Compare the delivered coefficient of restitution with the scene's; None without balls."""
    by_pair = _all(record)
    if not by_pair:
        return None
    assert record.scene.collisions is not None
    wanted, ratios, errors = record.scene.collisions.restitution, [], []
    for pair, hits in by_pair.items():
        loads = rotation.norm(_pull(record, pair)[hits.row, hits.step])
        fast = hits.approach > _SLOW * np.maximum(record.fall, record.frame * loads)
        error = np.abs(hits.parting - wanted * hits.approach)
        errors.append(np.where(fast, error / np.maximum(hits.approach, hits.least), np.nan))
        plain = fast & (hits.approach > hits.least)
        ratios += (hits.parting[plain] / hits.approach[plain]).tolist()
    return _figures(record, errors, restitution_note(ratios, wanted))


@check("collision friction", "friction")
def collision_friction(record: Record) -> Figures:
    """Compare tangential impulses with Coulomb's law, over μ times normal; None without balls.

    They must stop the slip, or be μ times the normal impulse against it. The slip of balls with
    uneven inertia may turn: there only the impulse's size counts, less what it may lose by that.
    """
    return _figures(record, [_aside(record, pair, hits) for pair, hits in _all(record).items()])


@check("collision gap", "contact_gap")
def collision_gap(record: Record) -> Figures:
    """Measure the distance of balls where they rebound, over the scene's length.

    An overlap that the declared contact time explains does not count, and no overlap counts without
    a declared time. None without balls.
    """
    time = record.contact_time
    gaps = [
        np.maximum(hits.gap, 0.0 if time is None else -hits.gap - time * hits.approach)
        for hits in _all(record).values()
    ]
    return _figures(record, [gap / record.scene.length for gap in gaps])


@functools.lru_cache(maxsize=64)
def pairs_of_balls(mechanism: Mechanism) -> list[int]:
    """Return indices of sphere pairs that are balls: unconnected bodies with one centred sphere."""
    tied = {body for joint in mechanism.joints for body in (joint.parent, joint.child)}
    tied |= {body for pair in (*mechanism.distances, *mechanism.springs) for body in pair.bodies}
    spheres = mechanism.sphere_body.tolist()
    single = [body not in tied and spheres.count(body) == 1 for body in spheres]
    centred = np.linalg.norm(mechanism.sphere_offset, axis=1) <= _CENTRED
    balls = centred & np.array(single, dtype=bool)
    return np.flatnonzero(balls[mechanism.sphere_pairs].all(axis=1)).tolist()


@functools.lru_cache(maxsize=1)
def _all(record: Record) -> dict[int, Hits]:
    """Find the collisions that can be isolated, keyed by the index of the pair."""
    return {pair: _of_pair(record, pair) for pair in pairs_of_balls(record.mechanism)}


def _of_pair(record: Record, pair: int) -> Hits:
    mechanism, frame = record.mechanism, record.frame
    one, other = mechanism.sphere_body[mechanism.sphere_pairs[pair]]
    reach = mechanism.sphere_radius[mechanism.sphere_pairs[pair]]

    def look(bodies: BodyStates) -> Neighbours:
        return neighbours_of(mechanism, bodies)[:, pair]

    row, step = np.nonzero(_alone(record, pair))
    there, before, falling = at_touch(record, row, step, step, look)
    _, after, rising = at_touch(record, row, step, step + 1, look)
    end, pull = record.bodies[row, step + 1], _pull(record, pair)[row, step]
    speed = end.velocity[:, one] - end.velocity[:, other] - (frame - falling)[:, None] * pull
    turning = reach @ end.angular_velocity[:, [one, other]]
    # A soft contact turns with the balls as long as it lasts; those that stay together do not part.
    parted = (after.climb > 0.0) & (rising <= 0.0)
    normal = np.where(parted[:, None], after.normal, before.normal)
    parting = rotation.dot(speed, normal)
    slip_after = speed - parting[:, None] * normal - rotation.cross(turning, normal)
    yields = _yields(mechanism, pair, there, before.normal)
    if not _is_even(mechanism, pair):  # the spins change until the frame
        slip_after = np.where(parted[:, None], after.slip, slip_after)
    changes = np.stack([slip_after - before.slip, -before.slip], axis=-1)
    ways = [w / np.maximum(rotation.norm(w), _TINY)[:, None] for w in (before.slip, slip_after)]
    straight = rotation.norm(ways[0] + ways[1]) / 2.0
    aside, stopping = np.moveaxis(np.linalg.solve(yields, changes), -1, 0)
    rates = 1.0 / np.where(parted, after.climb, np.nan) - 1.0 / before.climb
    gap = -(frame - falling + rising) / rates
    # A near miss may come almost as near as a touch.
    exact = np.abs(before.gap) <= _EXACT * frame * -before.climb
    hits = Hits(row, step, -before.climb, parting, before.slip, aside, stopping, straight, gap)
    return hits[exact & (falling >= 0.0)]


def _is_even(mechanism: Mechanism, pair: int) -> bool:
    """Return whether both balls of a pair have equal moments about all axes."""
    bodies = mechanism.sphere_body[mechanism.sphere_pairs[pair]]
    moments = np.linalg.eigvalsh(mechanism.inertia[bodies])
    return bool((np.ptp(moments, axis=1) <= _CENTRED * moments.max(axis=1)).all())


def _yields(mechanism: Mechanism, pair: int, bodies: BodyStates, normal: Array) -> Array:
    """Return the change of a pair's slip by a tangential impulse [1/kg], (collision, 3, 3)."""
    spheres = mechanism.sphere_pairs[pair]
    own, radius = mechanism.sphere_body[spheres], mechanism.sphere_radius[spheres]
    native = bodies.native[:, own]  # after steps of an integrator
    turn = rotation.matrix(native / np.linalg.norm(native, axis=-1, keepdims=True))
    # Rows turn a ball by unit impulses on its contact point, in the ball's frame.
    lever = np.cross(normal[:, None], np.eye(3))[:, None] @ turn * radius[:, None, None]
    turned = lever @ np.linalg.inv(mechanism.inertia[own]) @ np.swapaxes(lever, -1, -2)
    aside = turned.sum(axis=1)
    # The slip may have a part along the normal, which turns while a soft contact lasts.
    along = normal[:, :, None] * normal[:, None] * np.trace(aside, axis1=1, axis2=2)[:, None, None]
    return np.asarray(aside + along / 2.0 + np.eye(3) * np.sum(1.0 / mechanism.mass[own]))


def _pull(record: Record, pair: int) -> Array:
    """Compute relative accelerations of a pair's balls by loads [m/s²], (trajectory, step, 3)."""
    mechanism = record.mechanism
    one, other = mechanism.sphere_body[mechanism.sphere_pairs[pair]]
    acceleration = record.force / mechanism.mass[:, None]
    return np.asarray(acceleration[:, :, one] - acceleration[:, :, other])


def _alone(record: Record, pair: int) -> Mask:
    """Find steps that may hold a whole collision of a pair, and no other touch of its balls.

    The collision is over if the balls are apart again, or do not push each other in the step after.
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
    """Compute deviations of tangential impulses from Coulomb's, over μ · normal, (collision,)."""
    mechanism, collisions = record.mechanism, record.scene.collisions
    assert collisions is not None
    bodies = mechanism.sphere_body[mechanism.sphere_pairs[pair]]
    yields = float(np.sum(1.0 / mechanism.mass[bodies]))
    push = (hits.approach + hits.parting) / yields
    most = collisions.friction * push
    stopping, actual = rotation.norm(hits.stopping), rotation.norm(hits.aside)
    wanted = hits.stopping * np.minimum(1.0, most / np.maximum(stopping, _TINY))[:, None]
    off = rotation.norm(hits.aside - wanted)
    if not _is_even(mechanism, pair):  # the slip may turn, and friction with it
        least = most * hits.straight - actual
        left = rotation.norm(hits.stopping - hits.aside)
        off = np.maximum(actual - most, np.minimum(least, left).clip(0.0))
    scale = np.maximum(push, hits.least / yields)
    return np.asarray(off / (scale * (collisions.friction or 1.0)))


def _figures(record: Record, values: list[Array], note: str = "") -> Figures:
    """Put values of the collisions of all pairs at the frames after them."""
    of, by_pair = [sphere.body for sphere in record.scene.contacts], _all(record)
    pairs = record.mechanism.sphere_pairs[list(by_pair)].tolist()
    hits = zip(by_pair.values(), values, strict=True)
    parts = at_impacts(record, [(each.row, each.step, off) for each, off in hits])
    return Figures(parts, [f"{of[a]} and {of[b]}" for a, b in pairs], note)
