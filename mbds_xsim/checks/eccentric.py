"""Single eccentric impacts, compared with the two laws that engines have for them.

- Rigid: Newton's restitution, and Coulomb's friction against the slip that the impact leaves, or
  enough friction to leave none.
- Compliant: restitution of the normal work, and friction against the slip at each instant.

With friction the two laws give different rebounds. An impact has to follow one of them, in both
restitution and friction. An engine has one law for all impacts, and the errors of its steps differ
from impact to impact, so the mean over all impacts of a run shows the coefficients far better than
any single one.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Picked
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.ground import (
    Impacts,
    Push,
    fast_impacts_of,
    free_acceleration,
    lowest,
    pushed,
    pushes_of,
)
from mbds_xsim.checks.rebounds import at_impacts, rebound_figures
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.spheres import direction
from mbds_xsim.scene.joint_space import BodyStates

_RESTITUTION = 5.0  # times the budget of balls; springs of few steps are off by up to 0.033
_FRICTION = 15.0  # times the budget; PyBullet's friction, oblique to the slip, is off by up to 0.24
# Share of the coefficient that an impact by the compliant law leaves at least; in 60 throws of a
# cubli in Exudyn and MuJoCo it is 0.63.
_LEFT = 0.5
_BLUR = 3.0  # times the rebound's speed that the course does not explain
_PARTS = 200  # parts of an impact
_STILL = 1e-9  # slip too slow to have a direction [m/s]
_ENOUGH = 8  # least number of impacts
_FULL = 2.0  # least number of impacts with full slip, for friction
_ERRORS = 4.0  # standard errors
_POOLED_RESTITUTION = 0.02  # error of springs of a few steps (MuJoCo: 9e-3)
_POOLED_FRICTION = 0.03  # the same, as a share of μ (MuJoCo: 1.5e-2)
_MORE = 0.05  # share by which μ is raised to differentiate a law
_SLIPS = 0.05  # share of the arriving speed; a rebound with less slip may have stuck
_EXPLAINED = 3e-3  # share of the arriving speed; smaller errors of the rebound count as this


@check("eccentric restitution", lambda record: _budgets(record)[0])
def eccentric_restitution(record: Record) -> Figures | None:
    """Compare the restitution of single eccentric impacts with the scene's coefficient.

    It is that of speed or of normal work, whichever law the impact fits. Impacts whose rebound is
    not seen must allow half of the coefficient. None if all are balls.
    """
    groups = _deviations(record)
    if not groups:
        return None
    rigid = np.concatenate([off[2] for _, _, off in groups])
    remark = f"; {rigid.sum():.0f} of {len(rigid)} impacts by the rigid law" if len(rigid) else ""
    errors, least = [off[0] for _, _, off in groups], _LEFT * record.ground.restitution
    return rebound_figures(record, _groups(record), errors, least, remark)


@check("eccentric friction", lambda record: _budgets(record)[1])
def eccentric_friction(record: Record) -> Figures:
    """Compare the friction of single eccentric impacts with Coulomb's law, over μ times normal."""
    groups = _deviations(record)
    parts = at_impacts(record, [(hits.row, hits.step, off[1]) for _, hits, off in groups])
    return Figures(parts, [name for name, _, _ in groups])


def _budgets(record: Record) -> tuple[float, float]:
    budget = record.scene.budget
    return _RESTITUTION * budget.restitution, _FRICTION * budget.friction


def _groups(record: Record) -> list[Push]:
    """Return the groups that are not balls."""
    return [push for push in pushes_of(record) if not push.ball]


@functools.lru_cache(maxsize=1)
def _deviations(record: Record) -> list[tuple[str, Impacts, Array]]:
    """Return names and impacts of groups that are not balls, and deviations from the best law.

    The law is the one that an impact fits best. The array, of shape (3, impact), has deviations of
    restitution and friction, and 1 where the rigid law fits best.
    """
    impacts = [(push.name, fast_impacts_of(record, push)) for push in _groups(record)]
    return [(name, hits, _least(record, hits)) for name, hits in impacts]


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
    # Impulse missing to leave no slip, and deviation from the cone's edge against it.
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
    """Outcome of impacts by the compliant law, one entry per impact."""

    velocity: Array
    """Final velocity of the sphere's lowest point [m/s], shape (impact, 3)."""
    friction: Array
    """Horizontal impulse [N·s], shape (impact, 2)."""
    restitution: Array
    """Square root of the normal work given back over that taken (Stronge 1990, Proc. R. Soc. A
    431, 169)."""


@functools.lru_cache(maxsize=4)
def course_of(record: Record, hits: Impacts, coefficient: float) -> Course:
    """Follow impacts through their recorded normal impulse, with a coefficient of friction.

    In a compliant contact the impulse builds up until the sphere leaves. At each instant friction
    opposes the slip with μ times the normal impulse, or holds the point if less is enough (Routh
    1905, Dynamics of a System of Rigid Bodies; in three dimensions Keller 1986, J. Appl. Mech. 53,
    1). The only assumption about the spring is that its push is half a sine in time, which matters
    only for what rotation and gravity add.
    """
    ends = (hits.before, hits.after)
    yields = [yielding(record, bodies, hits.sphere) for bodies in ends]
    touch = hits.row, hits.step, hits.sphere
    pulls = [free_acceleration(record, *touch, bodies) for bodies in ends]
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
    """Compute velocities of spheres' lowest points per unit impulse [1/kg], (impact, 3, 3)."""
    if not len(sphere):
        return np.zeros((0, 3, 3))
    mechanism, each = record.mechanism, np.arange(len(sphere))
    body = mechanism.sphere_body[sphere]
    response = pushed(mechanism, bodies, sphere)
    arm = lowest(mechanism, bodies.native[each, body], sphere)[:, None]
    turning = rotation.cross(response.angular_velocity[each, :, body], arm)
    return np.moveaxis(response.velocity[each, :, body] + turning, 1, 2)


def _friction(slip: Array, gives: Array, alone: Array, most: Array) -> Array:
    """Compute friction in a part of an impact [N·s], (impact, 2); it stops or opposes the slip.

    Args:
        slip: Slip at the part's start [m/s], shape (impact, 2).
        gives: Velocities per unit impulse, as from `yielding`.
        alone: Change of velocity by everything else [m/s], shape (impact, 3).
        most: Largest size of the impulse [N·s].
    """
    soft = gives[:, :2, :2]
    holds = np.asarray(
        np.linalg.solve(soft, -(slip + alone[:, :2])[..., None])[..., 0], dtype=float
    )
    needed = np.linalg.norm(holds, axis=1)
    ahead = np.einsum("kij,kj->ki", soft, direction(slip)) * most[:, None]
    middle = direction(slip + 0.5 * (alone[:, :2] - ahead))
    still = np.linalg.norm(slip, axis=1) < _STILL
    against = np.where(still[:, None], direction(holds), -middle)
    return np.where((needed <= most)[:, None], holds, most[:, None] * against)


@dataclass(frozen=True, eq=False)
class ImpactEvidence(Picked):
    """Evidence from impacts by the rigid and by the compliant law; axes are (law, impact)."""

    restitution: Array
    """Excess over the scene's coefficient."""
    weight: Array
    """Weight of each impact."""
    product: Array
    """Product of the residual friction and the effect of a larger μ."""
    square: Array
    """Square of the effect of a larger μ."""

    @property
    def known(self) -> ImpactEvidence:
        """Impacts of which every number is finite."""
        return self[:, np.isfinite(list(vars(self).values())).all(axis=(0, 1))]

    @staticmethod
    def joined(parts: list[ImpactEvidence]) -> ImpactEvidence:
        """Join the impacts of several groups of bodies or trajectories."""
        fields = zip(*(vars(part).values() for part in parts), strict=True)
        return ImpactEvidence(*(np.concatenate(each, axis=1) for each in fields))


@dataclass(frozen=True)
class Pool:
    """Coefficients that impacts show together, as deviations from the scene's."""

    impacts: int
    law: str
    restitution: float
    restitution_allowed: float
    friction: float
    """Deviation as a share of μ."""
    friction_allowed: float

    @staticmethod
    def of(evidence: ImpactEvidence) -> Pool | None:
        """Average by the law with the smaller scatter of impacts; None with few impacts.

        Impacts that a law cannot follow, such as those that take no normal work, are left out.
        """
        evidence = evidence.known
        count = evidence.weight.shape[1]
        if count < _ENOUGH:
            return None
        total = evidence.weight.sum(axis=1)
        mean = (evidence.weight * evidence.restitution).sum(axis=1) / total
        off = evidence.weight * (evidence.restitution - mean[:, None])
        error = np.sqrt((off**2).sum(axis=1)) / total
        square = evidence.square.sum(axis=1)
        known = square > _FULL
        share = np.where(known, evidence.product.sum(axis=1) / np.maximum(square, _FULL), 0.0)
        rest = evidence.product - share[:, None] * evidence.square
        spread = np.where(known, np.sqrt((rest**2).sum(axis=1)) / np.maximum(square, _FULL), np.inf)
        k = int((error * spread if known.all() else error).argmin())
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
        """Deviations of restitution and friction over what is allowed."""
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

    Figures are deviations over what is allowed: 0.02 of restitution and a share of 0.03 of
    friction, plus four standard errors each. None with fewer than eight eccentric impacts.
    """
    evidence = impact_evidence_of(record)
    pool = None if evidence is None else Pool.of(evidence)
    if pool is None:
        return None
    parts = record.at_end(np.broadcast_to(pool.used, (len(record.finite), 2)))
    return Figures(parts, ("restitution", "friction"), str(pool))


def impact_evidence_of(record: Record) -> ImpactEvidence | None:
    """Collect evidence from impacts of all groups that are not balls; None without such groups."""
    groups = _groups(record)
    if not groups:
        return None
    return ImpactEvidence.joined(
        [_evidence(record, fast_impacts_of(record, push)) for push in groups]
    )


def _evidence(record: Record, hits: Impacts) -> ImpactEvidence:
    laws = (_by_rigid(record, hits), _by_compliant(record, hits))
    return ImpactEvidence(*(np.stack(values) for values in zip(*laws, strict=True)))


def _by_rigid(record: Record, hits: Impacts) -> tuple[Array, Array, Array, Array]:
    """Evaluate impacts by the rigid law; friction shows where they leave a slip."""
    ground = record.ground
    speed = np.linalg.norm(hits.rebound, axis=1)
    slips = (speed > _SLIPS * hits.arriving).astype(float)
    along = np.einsum("ki,ki->k", hits.impulse[:, :2], -direction(hits.rebound))
    share = along / ((ground.friction or 1.0) * hits.impulse[:, 2]) - 1.0
    delivered = hits.leaving / hits.arriving
    return delivered - ground.restitution, np.ones(len(speed)), slips * share, slips


def _by_compliant(record: Record, hits: Impacts) -> tuple[Array, Array, Array, Array]:
    """Evaluate impacts by the compliant law; unexplained rebound is not restitution."""
    ground, mu = record.ground, record.ground.friction
    course, more = (course_of(record, hits, share * mu) for share in (1.0, 1.0 + _MORE))
    most = (mu or 1.0) * hits.impulse[:, 2:]
    residual = (hits.impulse[:, :2] - course.friction) / most
    adds = (more.friction - course.friction) / (_MORE * most)
    blur = (course.velocity[:, 2] - hits.leaving) / hits.arriving
    return (
        course.restitution - ground.restitution - blur,
        1.0 / (blur**2 + _EXPLAINED**2),
        np.einsum("ki,ki->k", residual, adds),
        np.einsum("ki,ki->k", adds, adds),
    )
