"""Single impacts beside the centre of mass, held against the two laws that engines have for them.

- Rigid: Newton's restitution, and Coulomb's friction against the slip that the impact leaves, or
  enough of it to leave none.
- Compliant: restitution of the normal work, and friction against the slip of each moment.

With friction beside the centre of mass the two give different rebounds. An impact has to keep to
one of them, in restitution and in friction. An engine has one law for all impacts, and what its
steps leave of it differs from impact to impact, so that the mean of all impacts of a run tells the
coefficients far better than any of them does.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.ground import (
    Impacts,
    at_impacts,
    fast_impacts_of,
    followed,
    lowest,
    one_sphere,
    pushed,
    pushes_of,
    told_restitution,
)
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import BodyStates

_RESTITUTION = 5.0  # times the budget of balls; springs of a few steps give up to 0.033
_FRICTION = 15.0  # times the budget; PyBullet's friction beside the slip gives up to 0.24
_BLUR = 3.0  # times the rebound's speed that the course does not explain
_PARTS = 200  # of an impact
_MOMENT = 1e-6  # over which accelerations are differences [s]
_STILL = 1e-9  # slip that has no direction [m/s]
_ENOUGH = 8  # impacts; fewer tell nothing
_SEEN = 2.0  # impacts with full slip, at least, for friction
_ERRORS = 4.0  # standard errors
_POOLED_RESTITUTION = 0.02  # that springs of a few steps leave (MuJoCo: 9e-3)
_POOLED_FRICTION = 0.03  # of μ, the same (MuJoCo: 1.5e-2)
_MORE = 0.05  # friction by which the law is differentiated, as a share
_SLIPS = 0.05  # of the arriving speed: a rebound with less slip may have stuck
_EXPLAINED = 3e-3  # of the arriving speed, below which a rebound is as good as explained


@check("eccentric restitution", lambda record: _budgets(record)[0])
def eccentric_restitution(record: Record) -> Figures | None:
    """Compare what single eccentric impacts give back with the scene's coefficient, else None.

    Of speed or of normal work, whichever law the impact keeps to.
    """
    groups = _deviations(record)
    if not groups:
        return None
    ratios = [ratio for _, hits, _ in groups for ratio in (hits.leaving / hits.arriving).tolist()]
    note = told_restitution(ratios, record.ground.restitution)
    if ratios:
        rigid = sum(int(off[2].sum()) for _, _, off in groups)
        note += f"; {rigid} of {len(ratios)} impacts by the rigid law"
    return _figures(record, 0, note)


@check("eccentric friction", lambda record: _budgets(record)[1])
def eccentric_friction(record: Record) -> Figures:
    """Compare the friction of single eccentric impacts with Coulomb's law, over μ · normal."""
    return _figures(record, 1)


def _figures(record: Record, kind: int, note: str = "") -> Figures:
    groups = _deviations(record)
    parts = at_impacts(record, [(hits.row, hits.step, off[kind]) for _, hits, off in groups])
    return Figures(parts, [name for name, _, _ in groups], note)


def _budgets(record: Record) -> tuple[float, float]:
    budget = record.scene.budget
    return _RESTITUTION * budget.restitution, _FRICTION * budget.friction


@functools.lru_cache(maxsize=1)
def _deviations(record: Record) -> list[tuple[str, Impacts, Array]]:
    """Name and impacts of each group that is no ball, and how far they are from a law.

    That is the law that an impact keeps to best: deviations of restitution and of friction, and 1
    where it is the rigid one, shape (3, impact).
    """
    pushes = [push for push in pushes_of(record) if not push.ball]
    found = [(push.name, fast_impacts_of(record, push)) for push in pushes]
    return [(name, hits, _least(record, hits)) for name, hits in found]


def _least(record: Record, hits: Impacts) -> Array:
    laws = np.array([_from_rigid(record, hits), _from_compliant(record, hits)])
    worst = (laws / np.array(_budgets(record))[:, None]).max(axis=1)
    rigid = worst[0] <= worst[1]
    return np.concatenate([np.where(rigid, *laws), rigid[None]])


def _from_rigid(record: Record, hits: Impacts) -> tuple[Array, Array]:
    ground = record.ground
    restitution = np.abs(hits.leaving / hits.arriving - ground.restitution)
    most, across = ground.friction * hits.impulse[:, 2], hits.impulse[:, :2]
    soft = yielding(record, hits.after, hits.sphere)[:, :2, :2]
    # What it would have taken to leave no slip, or to be at the cone's edge against it.
    missing = np.linalg.solve(soft, hits.rebound[..., None])[..., 0]
    speed = np.linalg.norm(hits.rebound, axis=1, keepdims=True)
    against = -most[:, None] * hits.rebound / np.maximum(speed, np.finfo(float).tiny)
    off = [np.linalg.norm(part, axis=1) for part in (missing, across - against)]
    beyond = np.maximum(np.linalg.norm(across, axis=1) - most, 0.0)
    size = (ground.friction or 1.0) * hits.impulse[:, 2]
    return restitution, np.maximum(np.minimum(*off), beyond) / size


def _from_compliant(record: Record, hits: Impacts) -> tuple[Array, Array]:
    ground = record.ground
    course = course_of(record, hits, ground.friction)
    blur = _BLUR * np.abs(course.velocity[:, 2] - hits.leaving) / hits.arriving
    off = np.linalg.norm(course.friction - hits.impulse[:, :2], axis=1)
    return (
        np.maximum(np.abs(course.restitution - ground.restitution) - blur, 0.0),
        off / ((ground.friction or 1.0) * hits.impulse[:, 2]),
    )


@dataclass(frozen=True, eq=False)
class Course:
    """What an impact comes to, one entry an impact."""

    velocity: Array
    """Of the sphere's lowest point at the end [m/s], shape (impact, 3)."""
    friction: Array
    """Horizontal impulse [N·s], shape (impact, 2)."""
    restitution: Array
    """Root of the normal work given back over the work taken (Stronge 1990, Proc. R. Soc. A 431,
    169)."""


@functools.lru_cache(maxsize=4)
def course_of(record: Record, hits: Impacts, coefficient: float) -> Course:
    """Follow impacts through their recorded normal impulse, with a coefficient of friction.

    On a compliant contact impulse builds up until the sphere leaves. Friction opposes the slip of
    each moment, μ times the normal impulse, or holds the point where that is enough (Routh 1905,
    Dynamics of a System of Rigid Bodies; in three dimensions Keller 1986, J. Appl. Mech. 53, 1).
    Nothing is assumed of the spring but that its push is half a sine in time, which only matters
    for what rotation and gravity add.
    """
    ends = (hits.before, hits.after)
    yields = [yielding(record, bodies, hits.sphere) for bodies in ends]
    pulls = [_acceleration(record, hits, bodies) for bodies in ends]
    duration = np.maximum(hits.duration, 0.0)[:, None] / _PARTS
    velocity = np.column_stack([hits.slip, -hits.arriving])
    friction = np.zeros((len(velocity), 2))
    work = np.zeros((2, len(velocity)))
    for k in range(_PARTS):
        share = (k + 0.5) / _PARTS
        gives = (1.0 - share) * yields[0] + share * yields[1]
        alone = ((1.0 - share) * pulls[0] + share * pulls[1]) * duration
        up = hits.impulse[:, 2] * np.diff(-0.5 * np.cos(np.pi * np.array([k, k + 1]) / _PARTS))
        alone = alone + gives[:, :, 2] * up[:, None]
        across = _friction(velocity[:, :2], gives, alone, coefficient * up)
        change = alone + np.einsum("kij,kj->ki", gives[:, :, :2], across)
        speed = velocity[:, 2] + 0.5 * change[:, 2]
        work += up * np.stack([np.maximum(-speed, 0.0), np.maximum(speed, 0.0)])
        velocity, friction = velocity + change, friction + across
    return Course(velocity, friction, np.sqrt(work[1] / work[0]))


def yielding(record: Record, bodies: BodyStates, sphere: Index) -> Array:
    """Velocity that a unit impulse on a sphere's lowest point gives it [1/kg], (impact, 3, 3)."""
    if not len(sphere):
        return np.zeros((0, 3, 3))
    mechanism, each = record.mechanism, np.arange(len(sphere))
    body = mechanism.sphere_body[sphere]
    given = pushed(mechanism, bodies, sphere)
    arm = lowest(mechanism, bodies.native[each, body], sphere)[:, None]
    turning = rotation.cross(given.angular_velocity[each, :, body], arm)
    return np.moveaxis(given.velocity[each, :, body] + turning, 1, 2)


def _acceleration(record: Record, hits: Impacts, bodies: BodyStates) -> Array:
    """Of the lowest point without the ground [m/s²], shape (impact, 3)."""
    inputs = (values[hits.row, hits.step] for values in (record.batch.force, record.torque))
    force, torque = inputs
    ends = []
    for moment in (-_MOMENT, _MOMENT):
        moments = np.full(len(hits.row), moment)
        there = followed(record, bodies, force, torque, moments)
        point = one_sphere(record, there, hits.sphere)
        ends.append(np.column_stack([point.slip, point.climb]))
    return np.asarray((ends[1] - ends[0]) / (2.0 * _MOMENT))


def _friction(slip: Array, gives: Array, alone: Array, most: Array) -> Array:
    """Impulse of friction in a part [N·s], (impact, 2): it holds the point, or opposes its slip.

    Args:
        slip: At the part's start [m/s], shape (impact, 2).
        gives: As of `yielding`.
        alone: Change of velocity that the rest makes [m/s], shape (impact, 3).
        most: Largest size of the impulse [N·s].
    """
    soft = gives[:, :2, :2]
    holds = np.asarray(
        np.linalg.solve(soft, -(slip + alone[:, :2])[..., None])[..., 0], dtype=float
    )
    needed = np.linalg.norm(holds, axis=1)
    ahead = np.einsum("kij,kj->ki", soft, _direction(slip)) * most[:, None]
    middle = _direction(slip + 0.5 * (alone[:, :2] - ahead))
    still = np.linalg.norm(slip, axis=1) < _STILL
    against = np.where(still[:, None], _direction(holds), -middle)
    return np.where((needed <= most)[:, None], holds, most[:, None] * against)


def _direction(vectors: Array) -> Array:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(size, np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Shown:
    """What impacts show, by the rigid and by the compliant law; axes are (law, impact)."""

    restitution: Array
    """Above the scene's."""
    weight: Array
    """What an impact counts."""
    product: Array
    """Of what the law leaves of friction, with what a larger μ would add."""
    square: Array
    """Of what a larger μ would add."""

    @property
    def known(self) -> Shown:
        """Those of which every number is finite."""
        values = list(vars(self).values())
        finite = np.isfinite(values).all(axis=(0, 1))
        return Shown(*(value[:, finite] for value in values))

    @staticmethod
    def joined(parts: list[Shown]) -> Shown:
        """Put the impacts of several groups of bodies or trajectories together."""
        fields = ("restitution", "weight", "product", "square")
        return Shown(*(np.concatenate([getattr(p, k) for p in parts], axis=1) for k in fields))


@dataclass(frozen=True)
class Pool:
    """The coefficients that impacts show together, as deviations from the scene's."""

    impacts: int
    law: str
    restitution: float
    restitution_allowed: float
    friction: float
    """As a share of μ."""
    friction_allowed: float

    @staticmethod
    def of(shown: Shown) -> Pool | None:
        """Average by the law that impacts scatter less about; None with few impacts.

        What a law cannot follow, such as an impact in which it does no work, is left out.
        """
        shown = shown.known
        count = shown.weight.shape[1]
        if count < _ENOUGH:
            return None
        total = shown.weight.sum(axis=1)
        mean = (shown.weight * shown.restitution).sum(axis=1) / total
        off = shown.weight * (shown.restitution - mean[:, None])
        error = np.sqrt((off**2).sum(axis=1)) / total
        square = shown.square.sum(axis=1)
        seen = square > _SEEN
        share = np.where(seen, shown.product.sum(axis=1) / np.maximum(square, _SEEN), 0.0)
        left = shown.product - share[:, None] * shown.square
        spread = np.where(seen, np.sqrt((left**2).sum(axis=1)) / np.maximum(square, _SEEN), np.inf)
        k = int((error * spread if seen.all() else error).argmin())
        return Pool(
            impacts=count,
            law=("rigid", "compliant")[k],
            restitution=float(mean[k]),
            restitution_allowed=float(_POOLED_RESTITUTION + _ERRORS * error[k]),
            friction=float(share[k]),
            friction_allowed=float(_POOLED_FRICTION + _ERRORS * spread[k]),
        )

    @property
    def used(self) -> tuple[float, float]:
        """Restitution and friction over what is allowed."""
        return (
            abs(self.restitution) / self.restitution_allowed,
            abs(self.friction) / self.friction_allowed,
        )

    def __str__(self) -> str:
        return (
            f"{self.impacts} impacts by the {self.law} law: restitution off by "
            f"{self.restitution:+.4f}, allowed {self.restitution_allowed:.4f}; friction by a share "
            f"of {self.friction:+.4f}, allowed {self.friction_allowed:.4f}"
        )


@check("impact coefficients", 1.0)
def impact_coefficients(record: Record) -> Figures | None:
    """Compare the coefficients that all impacts of a run show together with the scene's.

    Deviations over what is allowed: 0.02 of restitution and a share of 0.03 of friction, with four
    standard errors. None where less than eight impacts beside centres of mass are seen.
    """
    shown = shown_of(record)
    pool = None if shown is None else Pool.of(shown)
    if pool is None:
        return None
    parts = record.at_end(np.broadcast_to(pool.used, (len(record.finite), 2)))
    return Figures(parts, ("restitution", "friction"), str(pool))


def shown_of(record: Record) -> Shown | None:
    """Collect what the impacts of all groups that are no balls show; None without such groups."""
    groups = [push for push in pushes_of(record) if not push.ball]
    if not groups:
        return None
    return Shown.joined([_shown(record, fast_impacts_of(record, push)) for push in groups])


def _shown(record: Record, hits: Impacts) -> Shown:
    laws = (_by_rigid(record, hits), _by_compliant(record, hits))
    return Shown(*(np.stack(values) for values in zip(*laws, strict=True)))


def _by_rigid(record: Record, hits: Impacts) -> tuple[Array, Array, Array, Array]:
    """Friction is known of impacts that leave a slip, which it opposes."""
    ground = record.ground
    speed = np.linalg.norm(hits.rebound, axis=1)
    slips = (speed > _SLIPS * hits.arriving).astype(float)
    against = -hits.rebound / np.maximum(speed, np.finfo(float).tiny)[:, None]
    along = np.einsum("ki,ki->k", hits.impulse[:, :2], against)
    share = along / ((ground.friction or 1.0) * hits.impulse[:, 2]) - 1.0
    delivered = hits.leaving / hits.arriving
    return delivered - ground.restitution, np.ones(len(speed)), slips * share, slips


def _by_compliant(record: Record, hits: Impacts) -> tuple[Array, Array, Array, Array]:
    """The share of the rebound that the course does not explain is no restitution."""
    ground, mu = record.ground, record.ground.friction
    course, more = (course_of(record, hits, share * mu) for share in (1.0, 1.0 + _MORE))
    most = (mu or 1.0) * hits.impulse[:, 2:]
    left = (hits.impulse[:, :2] - course.friction) / most
    adds = (more.friction - course.friction) / (_MORE * most)
    blur = (course.velocity[:, 2] - hits.leaving) / hits.arriving
    return (
        course.restitution - ground.restitution - blur,
        1.0 / (blur**2 + _EXPLAINED**2),
        np.einsum("ki,ki->k", left, adds),
        np.einsum("ki,ki->k", adds, adds),
    )
