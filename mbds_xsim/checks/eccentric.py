"""Single impacts beside the centre of mass, held against the two laws that engines have for them.

- Rigid: Newton's restitution, and Coulomb's friction against the slip that the impact leaves, or
  enough of it to leave none.
- Compliant: restitution of the normal work, and friction against the slip of each moment.

With friction beside the centre of mass the two give different rebounds. An impact has to keep to
one of them, in restitution and in friction.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.course import course_of, yielding
from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.ground import pushes_of
from mbds_xsim.checks.impacts import Impacts, at_impacts, fast_impacts_of, told_restitution

Array = NDArray[np.float64]

_RESTITUTION = 5.0  # times the budget of balls; springs of a few steps give up to 0.033
_FRICTION = 15.0  # times the budget; PyBullet's friction beside the slip gives up to 0.24
_BLUR = 3.0  # times the rebound's speed that the course does not explain


def eccentric_restitution(record: Record) -> Finding | None:
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
    return _finding(record, "eccentric restitution", 0, note)


def eccentric_friction(record: Record) -> Finding | None:
    """Compare the friction of single eccentric impacts with Coulomb's law, over μ · normal."""
    return _finding(record, "eccentric friction", 1) if _deviations(record) else None


def _finding(record: Record, check: str, kind: int, note: str = "") -> Finding:
    groups = _deviations(record)
    return Finding.of(
        check,
        "1",
        at_impacts(record, [(hits, off[kind]) for _, hits, off in groups]),
        budget=_budgets(record)[kind],
        names=tuple(name for name, _, _ in groups),
        note=note,
    )


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
